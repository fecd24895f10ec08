// Motion of a robot for a goal, sample by sample.
#include <nanobind/stl/function.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/variant.h>
#include <optional>
#include <variant>

#include "bind.hpp"
#include "handmap/ik_models.hpp"
#include "mapper.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

// Rows of tasks that are written in Python, in a configuration: residual, Jacobian and damping of each.
using TaskCallback =
    std::function<std::vector<std::tuple<nb::object, nb::object, nb::object>>(NumpyArray)>;

std::function<void(const Vector&, TaskRows&)> rows_of(const Ik& ik, const TaskCallback& linearise) {
  return [&](const Vector& q, TaskRows& rows) {
    static const nb::object& plain = numpy_attribute("ascontiguousarray");
    const auto numbers = [](const nb::object& of) {
      return vector_of(nb::cast<Array>(plain(of, "float64")));
    };
    const size_t size = static_cast<size_t>(ik.tree.size);
    rows.residual.clear();
    rows.jacobian.clear();
    rows.damping.assign(size, 0.0);
    for (const auto& task : linearise(array_of(q))) {
      const Vector residual = numbers(std::get<0>(task)), jacobian = numbers(std::get<1>(task)),
                   damping = numbers(std::get<2>(task));
      if (jacobian.size() != residual.size() * size ||
          (damping.size() != size && damping.size() != 1))
        throw std::invalid_argument("wrong sizes of a task's rows");
      append(residual, rows.residual);
      append(jacobian, rows.jacobian);
      for (size_t i = 0; i < size; ++i) rows.damping[i] += damping[damping.size() == 1 ? 0 : i];
    }
    rows.count = static_cast<int>(rows.residual.size());
  };
}

Vector margins_of(const Ik& ik, const std::optional<Array>& margins) {
  if (!margins) return {};
  if (!ik.pairs || margins->size() != ik.pairs->size())
    throw std::invalid_argument("wrong size of margins");
  return vector_of(*margins);
}

// A task with its aims and weights.
using DistancesGiven = std::tuple<const DistanceTask*, Array, Array>;
// Joint and place of a point, and of the one that is kept at an offset from it; the offset, its weight.
using OffsetGiven = std::tuple<Indices, Array, Array, double>;

AimedDistances aimed_of(const Tree& tree, const DistancesGiven& given) {
  const auto& [task, aims, weights] = given;
  expect(task != nullptr, "no task");
  expect_size(aims, task->first.size(), "distances");
  expect_size(weights, task->first.size(), "weights of distances");
  expect_joints(tree, task->points);
  return {task, vector_of(aims), vector_of(weights)};
}

OffsetTask offset_of(const Tree& tree, const OffsetGiven& given) {
  const auto& [joints, offsets, aim, weight] = given;
  expect(joints.size() == 2, "an offset has two points");
  expect_size(aim, 3, "aim");
  const std::vector<Attached> ends = attached_of(joints, offsets);
  expect_joints(tree, ends);
  return {ends[0], ends[1], points_of(aim)[0], weight / kLengthUnit};
}

// Residual, Jacobian and damping of a task in a configuration.
nb::tuple task_rows(const Tree& tree, const Array& q,
                    const std::variant<DistancesGiven, OffsetGiven>& task) {
  expect_size(q, tree.nq, "q");
  Placed at(tree);
  at.place(q.data());
  const DistancesGiven* distances = std::get_if<DistancesGiven>(&task);
  const TaskRows rows = distances ? rows_of(at, aimed_of(tree, *distances))
                                  : rows_of(at, offset_of(tree, std::get<OffsetGiven>(task)));
  const size_t count = static_cast<size_t>(rows.count), size = static_cast<size_t>(tree.size);
  return nb::make_tuple(array_of(rows.residual), array_of({count, size}, rows.jacobian.data()),
                        array_of(rows.damping));
}

// Move the hand; see ik.tasks.Goal.
Step solve(Ik& ik, const Array& points, const std::optional<Array>& wrists, const Array& rest,
           const nb::object& when, const std::optional<Array>& margins, double speed,
           const std::optional<Array>& regularisation, const std::vector<DistancesGiven>& distances,
           const std::vector<OffsetGiven>& offsets, const std::optional<TaskCallback>& rows) {
  expect_size(points, 3 * ik.tree.points.size(), "points");
  const size_t joints = ik.tree.joint_columns.size();
  Goal goal;
  goal.points = points_of(points);
  if (wrists) {
    expect_size(*wrists, 16 * ik.tree.parts.size(), "wrists");
    for (size_t i = 0; i < ik.tree.parts.size(); ++i)
      goal.wrists.push_back(pose_of(wrists->data() + 16 * i));
  }
  expect_size(rest, joints, "rest");
  const When moment = when_from(when);
  ik.set_postures(vector_of(rest), ik.motion.next(moment).granted, goal.postures);
  if (regularisation) {
    expect_size(*regularisation, joints, "regularisation");
    goal.regularise(vector_of(*regularisation));
  }
  for (const DistancesGiven& each : distances) goal.distances.add() = aimed_of(ik.tree, each);
  for (const OffsetGiven& each : offsets) goal.offsets.push_back(offset_of(ik.tree, each));
  if (rows) goal.further = rows_of(ik, *rows);
  Step step;
  seek(ik, goal, moment, margins_of(ik, margins), speed, step.result);
  finish(ik, step);
  return step;
}

void make_ik(Ik* self, const Tree& tree, const nb::bytes& options, const nb::bytes& limits,
             std::shared_ptr<const PairBounds> pairs, const std::optional<nb::bytes>& collisions) {
  Ik& ik = *new (self) Ik(tree);
  set_options(ik, model_of<IkModel>(options));
  set_gate(ik, model_of<BoxLimits>(limits), std::move(pairs),
           optional_model<CollisionModel>(collisions));
  ik.reserve();
}

// Take the stop that was admitted last, for one sample.
Step hold_still(Ik& ik, const nb::object& when) {
  Step step;
  hold(ik, when_from(when), step);
  return step;
}

// The detour of each hand, to go on with: the posture that it passes, the targets for which it was
// sought, and all of its numbers.
nb::list detours_of(Ik& ik) {
  nb::list found;
  for (Detour& detour : ik.detours) {
    DetourWriter writer;
    detour.fields(writer);
    const nb::object via = detour.via.empty() ? nb::none() : nb::cast(array_of(detour.via));
    const nb::object points = detour.points.empty() ? nb::none() : nb::cast(array_of(detour.points));
    found.append(nb::make_tuple(via, points, array_of(writer.numbers)));
  }
  return found;
}

using DetourGiven = std::tuple<nb::object, nb::object, Array>;

// Continue the motion on detours, as the hands do that these are copies of.
void go_on(Ik& ik, const std::vector<DetourGiven>& given) {
  expect(given.size() == ik.detours.size(), "a detour for each hand");
  std::vector<Detour> detours(given.size());
  for (size_t i = 0; i < given.size(); ++i) {
    DetourReader reader(vector_of(std::get<2>(given[i])));
    detours[i].fields(reader);
    expect(reader.left() == 0, "the numbers of a detour");
    detours[i].expect_hand(ik.tree);
  }
  ik.detours = std::move(detours);
}

}  // namespace

void bind_ik(nb::module_& m) {
  nb::class_<DistanceTask>(m, "PointDistances")
      .def("__init__",
           [](DistanceTask* self, const nb::bytes& distances) {
             new (self) DistanceTask(task_of(model_of<DistancesModel>(distances)));
           },
           "distances"_a);
  m.def("task_rows", &task_rows, "tree"_a, "q"_a, "task"_a);
  nb::class_<Ik, Gate>(m, "Ik")
      .def("__init__", &make_ik, "tree"_a, "options"_a, "limits"_a, "pairs"_a.none() = nb::none(),
           "collisions"_a.none() = nb::none())
      .def_ro("costs", &Ik::costs)
      .def_prop_ro("queries", [](const Ik& ik) { return ik.pairs ? ik.pairs->queries : 0; })
      .def_prop_ro("detours", exclusively(&detours_of))
      .def("go_on", exclusively(&go_on), "detours"_a)
      .def("hold", exclusively(&hold_still), "when"_a)
      .def("solve", exclusively(&solve), "points"_a, "wrists"_a.none(), "rest"_a, "when"_a,
           "margins"_a.none() = nb::none(), "speed"_a = 1.0, "regularisation"_a.none() = nb::none(),
           "distances"_a = std::vector<DistancesGiven>(), "offsets"_a = std::vector<OffsetGiven>(),
           "rows"_a.none() = nb::none());
}

}  // namespace handmap
