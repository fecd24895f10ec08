// What Python sees of the core: flat arrays in, one call a sample.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "arrays.hpp"
#include "build_guard.hpp"
#include "episode.hpp"
#include "person.hpp"
#include "posture.hpp"
#include "robot.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

nb::object wrist_of(const HumanPose& pose) {
  return pose.has_wrist ? array_of(pose.wrist) : nb::none();
}

// A copy of a pose, by copy or pickle, is one of Python.
nb::tuple reduced_pose(const HumanPose& pose) {
  const nb::object kind = module_of("mapping.method").object("HumanPose");
  return nb::make_tuple(kind, nb::make_tuple(array_of(pose.points), wrist_of(pose)));
}

// What makes the rows of tasks that are written in Python, at a configuration.
std::function<void(const Vector&, TaskRows&)> rows_of(PythonIk& ik, const nb::list& tasks) {
  if (tasks.size() == 0) return {};
  if (!ik.placed.is_valid()) ik.placed = ik.hand.attr("configuration")();
  return [&ik, &tasks](const Vector& q, TaskRows& rows) {
    static const nb::object& plain = numpy_attribute("ascontiguousarray");
    const auto numbers = [](const nb::handle& of) {
      return vector_of(nb::cast<Array>(plain(of, "float64")));
    };
    const size_t size = ik.tree.size;
    ik.placed.attr("place")(array_of(q));
    rows.residual.clear();
    rows.jacobian.clear();
    rows.damping.assign(size, 0.0);
    for (const nb::handle& task : tasks) {
      const nb::object found = task.attr("linearise")(ik.placed);
      const Vector residual = numbers(item(found, 0)), jacobian = numbers(item(found, 1)),
                   damping = numbers(item(found, 2));
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

using Postures = std::vector<std::pair<double, Array>>;

std::vector<Posture> postures_of(const Ik& ik, const Postures& given) {
  std::vector<Posture> postures;
  for (const auto& [weight, q] : given) {
    expect_size(q, ik.tree.joint_columns.size(), "postures");
    postures.push_back({weight, vector_of(q)});
  }
  return postures;
}

Vector margins_of(const Ik& ik, const std::optional<Array>& margins) {
  if (!margins) return {};
  if (!ik.pairs || margins->size() != ik.pairs->size())
    throw std::invalid_argument("wrong size of margins");
  return vector_of(*margins);
}

// Move the hand for a `Goal` of Python.
nb::object solve(PythonIk& ik, const nb::object& wanted) {
  const Fields given(wanted);
  Goal goal;
  goal.points = points_of(given.array("points", 3 * ik.tree.points.size()));
  if (const auto wrists = given.get<std::optional<Array>>("wrists")) {
    expect_size(*wrists, 16 * ik.tree.parts.size(), "wrists");
    for (size_t i = 0; i < ik.tree.parts.size(); ++i)
      goal.wrists.push_back(pose_of(wrists->data() + 16 * i));
  }
  goal.postures = postures_of(ik, given.get<Postures>("postures"));
  static const nb::object& PointOffset =
      *new nb::object(module_of("ik.tasks").object("PointOffset"));
  nb::list others;
  for (const nb::handle& each : given.object("tasks")) {
    const Fields task(nb::borrow(each));
    const DistanceTask* own = nullptr;
    if (nb::try_cast(nb::getattr(each, "core", nb::none()), own, false) && own) {
      goal.distances.push_back({own, task.numbers("distances"), task.numbers("weights")});
    } else if (nb::isinstance(each, PointOffset)) {
      goal.offsets.push_back(offset_of(task));
    } else {
      others.append(each);
    }
  }
  goal.further = rows_of(ik, others);
  take_motion(ik);
  PythonStep step;
  seek(ik, goal, when_from(given.object("dt")),
       margins_of(ik, given.get<std::optional<Array>>("margins")), given.get<double>("speed"),
       step.result);
  finish(ik, step);
  nb::object made = nb::cast(std::move(step));
  leave_motion(ik, made);
  return result_of(nb::cast<const PythonStep&>(made), ik.hand, nb::getattr(ik.gate, "links"));
}

// Take the stop that was admitted last, for one sample.
nb::object hold_still(PythonIk& ik, const nb::object& when) {
  take_motion(ik);
  PythonStep step;
  hold(ik, when_from(when), step);
  nb::object made = nb::cast(std::move(step));
  leave_motion(ik, made);
  return result_of(nb::cast<const PythonStep&>(made), ik.hand, nb::getattr(ik.gate, "links"));
}

// The detour of each hand, as a `Detour` of Python has it; none where something else has moved the
// robot since.
nb::list detours_of(const PythonIk& ik) {
  nb::list found;
  if (was_set(ik)) return found;
  for (size_t i = 0; i < ik.detours.size(); ++i) {
    const Detour& detour = ik.detours[i];
    const nb::object via = detour.via.empty() ? nb::none() : nb::cast(array_of(detour.via));
    std::vector<Vec3> points = detour.points;
    if (points.empty()) points.push_back({kInfinity, kInfinity, kInfinity});
    Vector known = detour.known;
    known.resize(ik.tree.parts[i].end - ik.tree.parts[i].first, 0.0);
    found.append(
        nb::make_tuple(via, array_of(points), array_of(known), detour.left, detour.wait));
  }
  return found;
}

// Continue the gate's motion on detours, as the hands do that these are copies of.
void go_on(PythonIk& ik, const nb::object& given) {
  take_motion(ik);
  ik.moved = nb::getattr(ik.gate, "read_motion");
  for (size_t i = 0; i < ik.detours.size(); ++i) {
    const nb::object detour = item(given, i), via = item(detour, 0);
    const Array points = nb::cast<Array>(item(detour, 1));
    const Array known = nb::cast<Array>(item(detour, 2));
    const size_t count = ik.tree.parts[i].end - ik.tree.parts[i].first;
    ik.detours[i] = {
        via.is_none() ? Vector() : vector_of(nb::cast<Array>(via)),
        points.size() == 3 * ik.tree.points.size() ? points_of(points) : std::vector<Vec3>(),
        known.size() == count ? vector_of(known) : Vector(), nb::cast<double>(item(detour, 3)),
        nb::cast<double>(item(detour, 4))};
  }
}

// Many samples of one goal each, one after the other and without the GIL, from where the hand is.
// Returns for each sample its configuration, displacement, stop times and status, one after the other.
NumpyArray solve_many(PythonIk& ik, const Array& points,
                                          const std::optional<Array>& wrists, const Array& dt,
                                          const Array& speed, const std::optional<Array>& margins,
                                          const Postures& postures) {
  const size_t count = dt.size(), m = 3 * ik.tree.points.size();
  expect_size(points, count * m, "points");
  expect_size(speed, count, "speed");
  if (wrists) expect_size(*wrists, 16 * count, "wrists");
  if (ik.tree.parts.size() > 1) throw std::invalid_argument("several hands");
  Goal goal;
  goal.points.resize(ik.tree.points.size());
  goal.postures = postures_of(ik, postures);
  const Vector kept = margins_of(ik, margins);
  double* to;
  NumpyArray numbers = array_of({count * (ik.tree.nq + 2 * ik.tree.size + 1)}, to);
  nb::gil_scoped_release released;
  Result result;
  for (size_t i = 0; i < count; ++i) {
    const double* from = points.data() + i * m;
    for (size_t k = 0; k < goal.points.size(); ++k)
      goal.points[k] = {from[3 * k], from[3 * k + 1], from[3 * k + 2]};
    if (wrists) goal.wrists = {pose_of(wrists->data() + 16 * i)};
    ik.solve(goal, When::after(dt.data()[i]), kept, speed.data()[i], result);
    for (const Vector* part : {&ik.motion.q, &ik.motion.displacement, &ik.motion.stop_times})
      to = std::copy(part->begin(), part->end(), to);
    *to++ = static_cast<double>(result.status);
  }
  return numbers;
}

nb::tuple solve_qp(const Array& H, const Array& c, const Array& lower, const Array& upper,
                   const std::optional<Array>& G, const std::optional<Array>& h) {
  const int n = static_cast<int>(c.size());
  Qp qp;
  const bool found = qp.solve(n, H.data(), c.data(), lower.data(), upper.data(),
                              h ? static_cast<int>(h->size()) : 0, G ? G->data() : nullptr,
                              h ? h->data() : nullptr);
  return nb::make_tuple(found, array_of(qp.x), qp.iterations);
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

// See measure.measure_shape, whose constants and arguments these are.
nb::tuple measure_shape(const Array& landmarks, const Array& palm) {
  const Fields constants = module_of("human.measure");
  const PersonMeter meter{constants.get<double>("_BENT"), constants.get<size_t>("_FEWEST_BENT"),
                          constants.get<double>("LARGEST_ROLL")};
  expect_size(palm, 15, "palm");
  if (landmarks.size() == 0 || landmarks.size() % (3 * kLandmarks))
    throw std::invalid_argument("wrong size of landmarks");
  const PersonShape shape = meter.measure(points_of(landmarks), points_of(palm));
  return nb::make_tuple(array_of({5, 3}, &shape.bases[0].x), array_of({5}, shape.rolls.data()));
}

// See measures.measure_episode.
nb::dict measure_episode(const nb::object& recorded, const nb::object& moved) {
  const Fields recording(recorded), trajectory(moved);
  const Array time = recording.get<Array>("time");
  const size_t count = time.size();
  const Array landmarks = recording.array("landmarks", 3 * kLandmarks * count);
  const Array errors = trajectory.get<Array>("point_error"), q = trajectory.get<Array>("q");
  const Flags seen = recording.get<Flags>("valid"),
                  followed = trajectory.get<Flags>("valid"),
                  at_limit = trajectory.get<Flags>("at_limit"),
                  at_speed = trajectory.get<Flags>("at_speed_limit");
  for (const size_t size : {errors.shape(0), q.shape(0), seen.size(), followed.size(),
                            at_limit.shape(0), at_speed.shape(0)})
    if (size != count) throw std::invalid_argument("columns of different lengths");
  const auto has_any = [&](const Flags& flags) {
    return std::count(flags.data(), flags.data() + count, true) > 0;
  };
  if (!has_any(seen) || !has_any(followed)) throw std::invalid_argument("no sample was followed");
  const EpisodeMeter meter{count, time.data(), landmarks.data(), seen.data(), followed.data(),
                           errors.data(), errors.shape(1), {at_limit.data(), at_limit.shape(1)},
                           {at_speed.data(), at_speed.shape(1)}, q.data(), q.shape(1)};
  Vector reaches = meter.reaches();
  nb::dict found;
  found["valid"] = static_cast<double>(std::count(seen.data(), seen.data() + count, true)) /
                   static_cast<double>(count);
  found["longest_gap_s"] = meter.longest_gap();
  found["bone_variation"] = meter.bone_variation();
  found["reach_mm"] = EpisodeMeter::mean_of(reaches);
  found["reach_p95_mm"] = percentile_of(reaches, 95.0);
  found["saturation"] = meter.share(meter.at_limit, false);
  found["speed_limited"] = meter.share(meter.at_speed_limit, true);
  found["jerk"] = meter.jerk();
  return found;
}

double smallest_gap_of(const Array& time, const Array& landmarks) {
  const Fields constants = module_of("human.contact_gap");
  expect_size(landmarks, 3 * kLandmarks * time.size(), "landmarks");
  if (time.size() == 0) throw std::invalid_argument("no samples");
  return smallest_gap(time.data(), points_of(landmarks), constants.get<double>("_MEDIAN_TIME"),
                      constants.get<double>("_PERCENTILE"));
}

// See ik.nearest_posture, whose constants and arguments these are.
nb::object nearest_posture(const Tree& tree, const nb::object& hand, const Array& targets,
                           const Array& costs, double rest_cost, const Array& start) {
  const Fields constants = module_of("ik.nearest_posture");
  const Fields of(hand);
  NearestPosture problem(tree);
  problem.settings = {constants.get<int>("_MOST_STEPS"), constants.get<double>("_SMALLEST_STEP"),
                      constants.get<double>("_LEAST_DECREASE"),
                      constants.get<double>("_SMALLEST_SHARE"), constants.get<double>("_ROUNDING"),
                      constants.get<double>("_LEAST_CURVATURE")};
  problem.points = reference_points(of);
  const size_t n = tree.joint_columns.size(), m = problem.points.size();
  problem.configuration = tree.rest;
  problem.rest = vector_of(of.array("rest", n));
  problem.lower = vector_of(of.array("lower_limits", n));
  problem.upper = vector_of(of.array("upper_limits", n));
  expect_size(targets, 3 * m, "targets");
  expect_size(costs, m, "costs");
  expect_size(start, n, "start");
  problem.targets = points_of(targets);
  problem.costs = vector_of(costs);
  for (double& cost : problem.costs) cost *= cost;
  problem.rest_cost = rest_cost * rest_cost;
  return nb::cast(array_of(problem.solve(vector_of(start))));
}

// Points by `PointSpec` in palm axes, of joint positions.
nb::object points_in_palm(const Tree& tree, const Array& q, const nb::object& points) {
  expect_size(q, tree.q_indices.size(), "q");
  Placed placed(tree);
  placed.place(tree.configuration(q.data()).data());
  const Pose from = inverse(placed.pose(tree.palm_origin.joint) * tree.palm);
  std::vector<Vec3> found;
  for (const Attached& point : attached_of(tree, points))
    found.push_back(from * placed.point(point));
  return array_of(found);
}

// Poses of frames of Pinocchio in a configuration.
nb::object poses_in(const Tree& tree, const Array& q, const nb::object& frames) {
  expect_size(q, tree.nq, "q");
  Placed placed(tree);
  placed.place(q.data());
  std::vector<Pose> found;
  for (const nb::handle& each : frames) {
    const Fields frame(nb::borrow(each));
    found.push_back(placed.pose(frame.get<int>("parentJoint") - 1) *
                    frame.pose("placement.homogeneous"));
  }
  return array_of(found);
}

Mat3 matrix_of(const Array& a) {
  expect_size(a, 9, "rotation");
  Mat3 found;
  std::copy(a.data(), a.data() + 9, found.m);
  return found;
}

// See surface_gaps: of joint positions (T, n), a column for the pairs from each of `starts` on.
nb::object smallest_distances(const Tree& tree, const PairBounds& bounds,
                              const Array& q, const Indices& starts, double most) {
  const size_t n = tree.q_indices.size(), rows = q.size() / n, columns = starts.size();
  Vector found;
  Placed placed(tree);
  SmallestDistances smallest(bounds);
  for (size_t t = 0; t < rows; ++t) {
    placed.place(tree.configuration(q.data() + t * n).data());
    smallest.place(placed);
    for (size_t g = 0; g < columns; ++g) {
      const size_t to = g + 1 < columns ? starts[g + 1] : bounds.pairs.size();
      found.push_back(smallest.among(starts[g], to, most));
    }
  }
  return array_of({rows, columns}, found.data());
}

}  // namespace
}  // namespace handmap

NB_MODULE(_core, m) {
  using namespace handmap;
  package() = nb::cast<std::string>(m.attr("__name__").attr("rpartition")(".")[0]);
  m.attr("SOURCES") = HANDMAP_SOURCES;
  // Caches of Python modules may outlive this one when the interpreter ends.
  nb::set_leak_warnings(false);
  nb::class_<DistanceTask>(m, "PointDistances").def("__init__", &make_distances);
  nb::class_<PythonIk>(m, "Ik")
      .def("__init__", &make_ik)
      .def("set_motion",
           [](PythonIk& ik, const Array& q, const Array& displacement, double dt,
              const Array& stop_times, double time) {
             set_motion(ik, q, displacement, dt, stop_times, time);
           },
           "q"_a, "displacement"_a, "dt"_a, "stop_times"_a, "time"_a = 0.0)
      .def_prop_ro("detours", &detours_of)
      .def("go_on", &go_on, "detours"_a)
      .def("hold", &hold_still, "when"_a)
      .def("solve", &solve, "goal"_a)
      .def("solve_many", &solve_many, "points"_a, "wrists"_a.none(), "dt"_a, "speed"_a,
           "margins"_a.none(), "postures"_a);
  nb::class_<PythonStep>(m, "Step")
      .def("__call__", &motion_of);
  nb::class_<Stages, PythonStep>(m, "Stages")
      .def("__reduce__", &reduced)
      .def_ro("pose", &Stages::pose)
      .def_prop_ro("status", &Stages::status)
      .def_prop_ro("asked", &Stages::read_asked)
      .def_prop_ro("ik", &read_ik)
      .def_prop_ro("command", &Stages::read_command);
  nb::class_<SampleReader>(m, "SampleReader")
      .def("__reduce__", &without_copy<SampleReader>)
      .def("follow", &SampleReader::follow)
      .def("map", &SampleReader::map_joints, "reader"_a.none(), "q"_a.none(), "wrist"_a.none(),
           "dt"_a.none())
      .def("map", &SampleReader::map_landmarks, "reader"_a.none(), "landmarks"_a.none(),
           "wrist"_a.none(), "dt"_a.none())
      .def("map_sample", &SampleReader::map_sample, "guard"_a, "smoother"_a, "reader"_a,
           "sample"_a.none(), "dt"_a.none(), "arrival"_a.none(), "origin"_a.none());
  nb::class_<SampleMapper, SampleReader>(m, "SampleMapper")
      .def(nb::init<nb::object, const nb::object&, const nb::object&>(), "ik"_a, "robot"_a,
           "target_map"_a)
      .def("run", &SampleMapper::run);
  nb::class_<Asker, SampleReader>(m, "Asker")
      .def(nb::init<const PythonIk&, const nb::object&, const nb::object&>(), "ik"_a, "hand"_a,
           "target_map"_a);
  nb::class_<Ask>(m, "Ask")
      .def("__reduce__", &reduced_ask)
      .def_ro("pose", &Ask::pose)
      .def_ro("map", &Ask::target_map)
      .def_ro("dt", &Ask::dt)
      .def_ro("speed", &Ask::speed)
      .def_prop_ro("rest", &Ask::rest)
      .def_prop_ro("targets", &Ask::read_targets);
  nb::class_<RobotMover>(m, "RobotMover")
      .def(nb::init<nb::object, const nb::object&, const nb::list&, nb::dict, double>(), "ik"_a,
           "robot"_a, "pinching"_a, "leaders"_a, "turns_in"_a)
      .def("__reduce__", &without_copy<RobotMover>)
      .def("map", &RobotMover::map, "reader"_a, "numbers"_a, "wrists"_a, "when"_a, "base"_a)
      .def("move", &RobotMover::move, "base"_a, "when"_a);
  nb::class_<HumanPose>(m, "HumanPose")
      .def("__reduce__", &reduced_pose)
      .def_prop_ro("points", [](const HumanPose& pose) { return array_of(pose.points); })
      .def_prop_ro("in_wrist", [](const HumanPose& pose) { return array_of(pose.in_wrist()); })
      .def_prop_ro("wrist", &wrist_of);
  nb::class_<TargetMap>(m, "TargetMap");
  nb::class_<TeleoperationMap, TargetMap>(m, "TeleoperationMap")
      .def("__init__", &make_teleoperation);
  nb::class_<HomogeneousMap, TargetMap>(m, "HomogeneousMap").def("__init__", &make_homogeneous);
  nb::class_<LandmarkReader>(m, "LandmarkReader")
      .def("__init__", &make_landmark_reader)
      .def("read", &read_landmarks, "landmarks"_a.none(), "wrist"_a.none());
  nb::class_<JointReader>(m, "JointReader")
      .def("__init__", &make_joint_reader)
      .def("read", &read_joints, "q"_a.none(), "wrist"_a.none());
  nb::class_<Tree>(m, "Tree")
      .def("__init__",
           [](Tree* self, const nb::object& hand) {
             make_frames(*new (self) Tree(make_tree(Fields(hand))), Fields(hand));
           })
      .def("moved", &moved_tree)
      .def("points", &points_in_palm)
      .def("poses", &poses_in)
      .def("nearest_posture", &nearest_posture)
      .def("smallest_distances", &smallest_distances);
  nb::class_<PairBounds>(m, "PairBounds").def("__init__", &make_bounds);
  m.def("measure_shape", &measure_shape);
  m.def("log3", [](const Array& rotation) {
    const Vec3 turn = log3(matrix_of(rotation));
    return array_of({3}, &turn.x);
  });
  m.def("exp3", [](const Array& turn) {
    expect_size(turn, 3, "turn");
    return array_of({3, 3}, exp3(points_of(turn)[0]).m);
  });
  m.def("quat_xyzw", [](const Array& rotation) {
    const Quat q = quat_of(matrix_of(rotation));
    return array_of(Vector{q.x, q.y, q.z, q.w});
  });
  m.def("smallest_gap", &smallest_gap_of);
  m.def("measure_episode", &measure_episode);
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
      .def("forget", &PythonGuard::forget)
      .def("check", &PythonGuard::check, "sample"_a, "arrival"_a.none())
      .def("holds", &PythonGuard::holds, "recording"_a)
      .def("judge", &PythonGuard::judge, "recording"_a);
  nb::class_<PythonSmoother>(m, "Smoother")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonSmoother::save)
      .def("smooth", &PythonSmoother::smooth)
      .def("wait", &PythonSmoother::wait)
      .def("restart", &PythonSmoother::restart)
      .def("forget", &PythonSmoother::forget);
  m.attr("RULES") = rule_names();
}
