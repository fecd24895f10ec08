// What Python sees of the core: flat arrays in, one call a sample.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "build.hpp"
#include "build_guard.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

void write_pose(const Pose& pose, double* m) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) m[4 * i + j] = pose.R(i, j);
    m[4 * i + 3] = pose.p[i];
  }
  m[12] = m[13] = m[14] = 0.0;
  m[15] = 1.0;
}

// A new array of Python that owns its numbers.
nb::ndarray<nb::numpy, double> array_of(size_t size, double*& data) {
  data = new double[size];
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  return nb::ndarray<nb::numpy, double>(data, {size}, owner);
}

void set_motion(Ik& ik, const Array& q, const Array& displacement, double dt,
                const Array& stop_times) {
  expect_size(q, ik.tree.nq, "q");
  expect_size(displacement, ik.tree.size, "displacement");
  expect_size(stop_times, ik.tree.size, "stop_times");
  ik.motion.q.assign(q.data(), q.data() + q.size());
  ik.motion.displacement.assign(displacement.data(), displacement.data() + displacement.size());
  ik.motion.dt = dt;
  ik.motion.stop_times.assign(stop_times.data(), stop_times.data() + stop_times.size());
}

// Configuration, displacement, stop times, points, wrist and bounds met, one after the other.
nb::tuple tuple_of(const Ik& ik, const Result& result) {
  const size_t n = ik.tree.size, m = result.points.size();
  double* to;
  auto numbers = array_of(ik.tree.nq + 3 * n + 3 * m + 16, to);
  to = std::copy(ik.motion.q.begin(), ik.motion.q.end(), to);
  to = std::copy(result.displacement.begin(), result.displacement.end(), to);
  to = std::copy(ik.motion.stop_times.begin(), ik.motion.stop_times.end(), to);
  to = std::copy(result.active.begin(), result.active.end(), to);
  for (const Vec3& point : result.points) {
    *to++ = point.x;
    *to++ = point.y;
    *to++ = point.z;
  }
  write_pose(result.wrist, to);
  return nb::make_tuple(numbers, static_cast<int>(result.status), result.iterations,
                        result.last_step);
}

// Targets of one sample for Python: points, wrist, aims, weights, margins and diagnostics.
void ask(const TargetMap& map, const Array& points, const std::optional<Array>& wrist,
         Asked& asked) {
  expect_size(points, 3 * map.human_points, "points");
  if (map.needs_wrist && !wrist) throw std::invalid_argument("no wrist");
  Pose pose;
  if (wrist) {
    expect_size(*wrist, 16, "wrist");
    pose = pose_of(wrist->data());
  }
  map.targets(points_of(points), wrist ? &pose : nullptr, asked);
}

nb::tuple tuple_of(const Asked& asked) {
  const size_t m = asked.points.size();
  double* to;
  auto numbers = array_of(3 * m + 16 + 2 * asked.aims.size() + asked.margins.size() +
                              asked.diagnostics.size(),
                          to);
  for (const Vec3& point : asked.points) {
    *to++ = point.x;
    *to++ = point.y;
    *to++ = point.z;
  }
  write_pose(asked.wrist, to);
  to += 16;
  for (const Vector* part : {&asked.aims, &asked.weights, &asked.margins, &asked.diagnostics})
    to = std::copy(part->begin(), part->end(), to);
  return nb::make_tuple(numbers, asked.is_clamped);
}

nb::tuple targets(const TargetMap& map, const Array& points, const std::optional<Array>& wrist) {
  Asked asked;
  ask(map, points, wrist, asked);
  return tuple_of(asked);
}

// Landmarks (21, 3) to points of the human, and the wrist that is fitted to the palm.
nb::ndarray<nb::numpy, double> read_landmarks(const LandmarkReader& reader, const Array& landmarks) {
  const std::vector<Vec3> all = points_of(landmarks);
  expect_size(landmarks, 3 * kLandmarks, "landmarks");
  double* to;
  auto numbers = array_of(3 * reader.used.size() + 16, to);
  for (const int i : reader.used) {
    *to++ = all[i].x;
    *to++ = all[i].y;
    *to++ = all[i].z;
  }
  write_pose(reader.fit(all), to);
  return numbers;
}

std::function<void(const Vector&, TaskRows&)> rows_of(const nb::object& linearise, int size) {
  if (linearise.is_none()) return {};
  return [&linearise, size](const Vector& q, TaskRows& rows) {
    double* to;
    auto at = array_of(q.size(), to);
    std::copy(q.begin(), q.end(), to);
    auto found = nb::cast<nb::tuple>(linearise(at));
    rows.residual = vector_of(nb::cast<Array>(found[0]));
    rows.jacobian = vector_of(nb::cast<Array>(found[1]));
    rows.damping = vector_of(nb::cast<Array>(found[2]));
    rows.count = static_cast<int>(rows.residual.size());
    if (rows.jacobian.size() != rows.residual.size() * size ||
        rows.damping.size() != static_cast<size_t>(size))
      throw std::invalid_argument("wrong sizes of a task's rows");
  };
}

using Postures = std::vector<std::pair<double, Array>>;

std::vector<Posture> postures_of(const Ik& ik, const Postures& given) {
  std::vector<Posture> postures;
  for (const auto& [weight, q] : given) {
    expect_size(q, ik.tree.joint_columns.size(), "postures");
    postures.push_back({weight, vector_of(q)});
  }
  return postures;
}

nb::tuple solve(Ik& ik, const Array& points, const std::optional<Array>& wrist, double dt,
                double speed, const std::optional<Array>& margins, const Postures& postures,
                const DistanceTask* distances, const std::optional<Array>& aims,
                const std::optional<Array>& aim_weights, const nb::object& linearise) {
  expect_size(points, 3 * ik.tree.points.size(), "points");
  Goal goal;
  goal.points = points_of(points);
  if (wrist) {
    expect_size(*wrist, 16, "wrist");
    goal.has_wrist = true;
    goal.wrist = pose_of(wrist->data());
  }
  goal.postures = postures_of(ik, postures);
  if (distances) {
    goal.distances = distances;
    goal.aims = vector_of(*aims);
    goal.aim_weights = vector_of(*aim_weights);
  }
  goal.further = rows_of(linearise, ik.tree.size);
  Vector kept;
  if (margins) {
    kept = vector_of(*margins);
    if (!ik.pairs || kept.size() != ik.pairs->pairs.size())
      throw std::invalid_argument("wrong size of margins");
  }
  Result result;
  ik.solve(goal, dt, kept, speed, result);
  return tuple_of(ik, result);
}

// A whole sample: the targets of a map, and the motion towards them.
nb::tuple follow(Ik& ik, const TargetMap& map, const Array& points,
                 const std::optional<Array>& wrist, double dt, double speed,
                 const Postures& postures) {
  Asked asked;
  ask(map, points, wrist, asked);
  if (asked.points.size() != ik.tree.points.size() ||
      (!asked.margins.empty() && (!ik.pairs || asked.margins.size() != ik.pairs->pairs.size())))
    throw std::invalid_argument("the map is of another hand");
  Goal goal;
  goal.points = asked.points;
  goal.has_wrist = true;
  goal.wrist = asked.wrist;
  goal.postures = postures_of(ik, postures);
  goal.distances = asked.distances;
  goal.aims = asked.aims;
  goal.aim_weights = asked.weights;
  Result result;
  ik.solve(goal, dt, asked.margins, speed, result);
  return nb::make_tuple(tuple_of(asked), tuple_of(ik, result));
}

nb::tuple solve_qp(const Array& H, const Array& c, const Array& lower, const Array& upper,
                   const std::optional<Array>& G, const std::optional<Array>& h) {
  const int n = static_cast<int>(c.size());
  Qp qp;
  const bool found = qp.solve(n, H.data(), c.data(), lower.data(), upper.data(),
                              h ? static_cast<int>(h->size()) : 0, G ? G->data() : nullptr,
                              h ? h->data() : nullptr);
  double* to;
  auto x = array_of(n, to);
  std::copy(qp.x.begin(), qp.x.end(), to);
  return nb::make_tuple(found, x, qp.iterations);
}

// Of two shapes of coal in two poses: distance, normal, and the first one's nearest point.
nb::tuple measure_shapes(const nb::object& a, const Array& pose_a, const nb::object& b,
                         const Array& pose_b) {
  Warm warm{};
  const Found found = measure(make_shape(Fields(a)), pose_of(pose_a.data()), make_shape(Fields(b)),
                              pose_of(pose_b.data()), warm);
  return nb::make_tuple(found.distance,
                        nb::make_tuple(found.normal.x, found.normal.y, found.normal.z),
                        nb::make_tuple(found.point.x, found.point.y, found.point.z));
}

}  // namespace
}  // namespace handmap

NB_MODULE(_core, m) {
  using namespace handmap;
  m.attr("SOURCES") = HANDMAP_SOURCES;
  nb::class_<DistanceTask>(m, "PointDistances").def("__init__", &make_distances);
  nb::class_<Ik>(m, "Ik")
      .def("__init__", &make_ik)
      .def("set_motion", &set_motion)
      .def("solve", &solve, "points"_a, "wrist"_a.none(), "dt"_a, "speed"_a, "margins"_a.none(),
           "postures"_a, "distances"_a.none(), "aims"_a.none(), "aim_weights"_a.none(),
           "linearise"_a.none())
      .def("follow", &follow, "map"_a, "points"_a, "wrist"_a.none(), "dt"_a, "speed"_a,
           "postures"_a);
  nb::class_<TargetMap>(m, "TargetMap").def("targets", &targets, "points"_a, "wrist"_a.none());
  nb::class_<TeleoperationMap, TargetMap>(m, "TeleoperationMap")
      .def("__init__", &make_teleoperation);
  nb::class_<HomogeneousMap, TargetMap>(m, "HomogeneousMap").def("__init__", &make_homogeneous);
  nb::class_<LandmarkReader>(m, "LandmarkReader")
      .def("__init__", &make_reader)
      .def("read", &read_landmarks);
  m.def("solve_qp", &solve_qp, "H"_a, "c"_a, "lower"_a, "upper"_a, "G"_a.none() = nb::none(),
        "h"_a.none() = nb::none());
  m.def("measure_shapes", &measure_shapes);
  nb::class_<PythonInputCheck>(m, "InputCheck")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonInputCheck::save)
      .def("update", &PythonInputCheck::update, "time"_a, "landmarks"_a,
           "wrist"_a.none() = nb::none())
      .def("alert", &PythonInputCheck::alert)
      .def("finish", &PythonInputCheck::finish)
      .def("examine", &PythonInputCheck::examine, "recording"_a)
      .def("finding", &PythonInputCheck::finding)
      .def("is_wrist_proven", &PythonInputCheck::is_wrist_proven);
  nb::class_<PythonGuard>(m, "StreamGuard")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonGuard::save)
      .def_prop_rw("state", &PythonGuard::state, &PythonGuard::set_state)
      .def("check", &PythonGuard::check, "sample"_a, "arrival"_a.none())
      .def("holds", &PythonGuard::holds, "recording"_a)
      .def("judge", &PythonGuard::judge, "recording"_a);
  m.attr("RULES") = rule_names();
}
