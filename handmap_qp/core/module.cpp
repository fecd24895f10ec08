// What Python sees of the core: flat arrays in, one call a sample.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "arrays.hpp"
#include "tracks.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

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

// Configuration, displacement, stop times, bounds met, points and wrist, one after the other.
NumpyArray result_of(const Step& step) {
  const Result& result = step.result;
  const Motion& motion = step.motion;
  Vector numbers = motion.q;
  append(motion.displacement, numbers);
  append(motion.stop_times, numbers);
  numbers.insert(numbers.end(), result.active.begin(), result.active.end());
  append(result.points, numbers);
  append(result.wrist, numbers);
  return array_of(numbers);
}

// Points, wrist, aims, weights, margins and diagnostics, likewise.
NumpyArray asked_of(const Step& step) {
  const Asked& asked = step.asked;
  Vector numbers;
  append(asked.points, numbers);
  append(asked.wrist, numbers);
  for (const Vector* part : {&asked.aims, &asked.weights, &asked.margins, &asked.diagnostics})
    append(*part, numbers);
  return array_of(numbers);
}

void make_pose(HumanPose* self, const Array& points, const std::optional<Array>& wrist) {
  HumanPose& pose = *new (self) HumanPose{points_of(points), wrist.has_value(), {}};
  if (wrist) {
    expect_size(*wrist, 16, "wrist");
    pose.wrist = pose_of(wrist->data());
  }
}

nb::object wrist_of(const HumanPose& pose) {
  return pose.has_wrist ? nb::cast(array_of(pose.wrist)) : nb::none();
}

// A copy of a pose, by copy or pickle, is one of Python.
nb::tuple reduced(const HumanPose& pose) {
  const nb::object kind = nb::module_::import_("handmap_qp.mapping.method").attr("HumanPose");
  return nb::make_tuple(kind, nb::make_tuple(array_of(pose.points), wrist_of(pose)));
}

// Numbers as they are, if they have a shape and no coordinate of them is farther than any hand.
std::optional<Array> plain(const nb::handle& given, std::initializer_list<size_t> shape) {
  Array numbers;
  if (!nb::try_cast(given, numbers, false) || numbers.ndim() != shape.size()) return {};
  size_t axis = 0;
  for (const size_t count : shape)
    if (numbers.shape(axis++) != count) return {};
  for (size_t i = 0; i < numbers.size(); ++i)
    if (!(std::abs(numbers.data()[i]) <= kFarthest)) return {};
  return numbers;
}

// A pose whose rotation is one up to rounding.
std::optional<Pose> plain_pose(const nb::handle& given) {
  const std::optional<Array> numbers = plain(given, {4, 4});
  if (!numbers) return {};
  const double* m = numbers->data();
  if (m[12] != 0.0 || m[13] != 0.0 || m[14] != 0.0 || m[15] != 1.0) return {};
  const Pose pose = pose_of(m);
  const Mat3 square = transposed(pose.R) * pose.R, eye;
  for (int i = 0; i < 9; ++i)
    if (!(std::abs(square.m[i] - eye.m[i]) <= kExactRotation)) return {};
  if (determinant(pose.R) < 0.0) return {};
  return pose;
}

// A sample of landmarks, or None for what Python has to look at.
std::optional<HumanPose> read_landmarks(const LandmarkReader& reader, const nb::handle& landmarks,
                                        const nb::handle& wrist) {
  const std::optional<Array> points = plain(landmarks, {kLandmarks, 3});
  if (!points) return {};
  if (wrist.is_none()) return reader.read(points->data(), nullptr);
  const std::optional<Pose> pose = plain_pose(wrist);
  if (!pose) return {};
  return reader.read(points->data(), &*pose);
}

// Likewise of joint angles.
std::optional<HumanPose> read_joints(JointReader& reader, const nb::handle& q,
                                     const nb::handle& wrist) {
  const std::optional<Array> angles = plain(q, {reader.size()});
  if (!angles) return {};
  const std::optional<Pose> pose = plain_pose(wrist);
  HumanPose found;
  if (!pose || !reader.read(angles->data(), *pose, found)) return {};
  return found;
}

Landmarks landmarks_of(const nb::handle& given) {
  const Array numbers = nb::cast<Array>(given);
  expect_size(numbers, 3 * kLandmarks, "landmarks");
  Landmarks points;
  for (int i = 0; i < kLandmarks; ++i)
    points[i] = {numbers.data()[3 * i], numbers.data()[3 * i + 1], numbers.data()[3 * i + 2]};
  return points;
}

// A `Track` of Python, a tuple in the order of its fields.
Track track_of(const nb::tuple& given) {
  Track track;
  track.points = landmarks_of(given[1]);
  track.centre = points_of(nb::cast<Array>(given[2])).at(0);
  const Array lengths = nb::cast<Array>(given[3]);
  expect_size(lengths, kFixed, "lengths");
  std::copy(lengths.data(), lengths.data() + kFixed, track.lengths.begin());
  track.velocity = points_of(nb::cast<Array>(given[4])).at(0);
  track.turning = points_of(nb::cast<Array>(given[5])).at(0);
  track.bending = landmarks_of(given[6]);
  track.dt = nb::cast<double>(given[7]);
  return track;
}

nb::module_ guard() { return nb::module_::import_("handmap_qp.stream.guard"); }

nb::object first_track_of(double now, const nb::object& landmarks) {
  const Track track = first_track(landmarks_of(landmarks));
  const Vec3 still;
  return guard().attr("Track")(
      now, array_of({kLandmarks, 3}, &track.points[0].x), array_of({3}, &track.centre.x),
      array_of({kFixed}, track.lengths.data()), array_of({3}, &still.x),
      array_of({3}, &still.x), array_of({kLandmarks, 3}, &track.bending[0].x));
}

nb::object change_of(const nb::tuple& before, const nb::tuple& sample, double dt) {
  Track moved = track_of(sample);
  const Change change = change_between(track_of(before), moved, dt);
  const nb::object track = guard().attr("Track")(
      sample[0], sample[1], sample[2], sample[3], array_of({3}, &moved.velocity.x),
      array_of({3}, &moved.turning.x), array_of({kLandmarks, 3}, &moved.bending[0].x), dt);
  return guard().attr("Change")(track, array_of({4}, change.sizes), change.is_turned,
                                change.is_alone, change.is_too_fast);
}

std::function<void(const Vector&, TaskRows&)> rows_of(const nb::object& linearise, int size) {
  if (linearise.is_none()) return {};
  return [&linearise, size](const Vector& q, TaskRows& rows) {
    auto found = nb::cast<nb::tuple>(linearise(array_of(q)));
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

Step solve(Ik& ik, const Array& points, const std::optional<Array>& wrist, double dt,
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
  Step step;
  ik.solve(goal, dt, kept, speed, step.result);
  finish(ik, step);
  return step;
}

void check_map(const Ik& ik, const TargetMap& map, const HumanPose& pose) {
  if (map.needs_wrist && !pose.has_wrist) throw std::invalid_argument("no wrist");
  if (pose.points.size() != map.human_points || map.rest.size() != ik.tree.q_indices.size())
    throw std::invalid_argument("the map is of other hands");
}

Step follow_pose(Ik& ik, const TargetMap& map, const HumanPose& pose, double dt, double speed) {
  check_map(ik, map, pose);
  Step step;
  follow(ik, map, pose, dt, speed, step);
  return step;
}

Step hold_still(Ik& ik, double dt) {
  Step step;
  hold(ik, dt, step);
  return step;
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
      .def("follow", &follow_pose, "map"_a, "pose"_a, "dt"_a, "speed"_a)
      .def("hold", &hold_still, "dt"_a);
  constexpr auto kOwned = nb::rv_policy::move;
  nb::class_<Step>(m, "Step")
      .def_prop_ro("q", [](const Step& step) { return array_of(step.q); }, kOwned)
      .def_prop_ro("wrist", [](const Step& step) { return array_of(step.result.wrist); }, kOwned)
      .def_prop_ro("asked", &asked_of, kOwned)
      .def_prop_ro("is_clamped", [](const Step& step) { return step.asked.is_clamped; })
      .def_prop_ro("result", &result_of, kOwned)
      .def_prop_ro("dt", [](const Step& step) { return step.motion.dt; })
      .def_prop_ro("status", [](const Step& step) { return static_cast<int>(step.result.status); })
      .def_prop_ro("iterations", [](const Step& step) { return step.result.iterations; })
      .def_prop_ro("last_step", [](const Step& step) { return step.result.last_step; });
  nb::class_<HumanPose>(m, "HumanPose")
      .def("__init__", &make_pose, "points"_a, "wrist"_a.none())
      .def("__reduce__", &reduced)
      .def_prop_ro("points", [](const HumanPose& pose) { return array_of(pose.points); }, kOwned)
      .def_prop_ro("in_wrist", [](const HumanPose& pose) { return array_of(pose.in_wrist()); }, kOwned)
      .def_ro("has_wrist", &HumanPose::has_wrist)
      .def_prop_ro("wrist", &wrist_of, kOwned);
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
  m.def("is_zero", [](const nb::object& landmarks) { return is_zero(landmarks_of(landmarks)); });
  m.def("first_track", &first_track_of);
  m.def("change_between", &change_of);
  m.def("solve_qp", &solve_qp, "H"_a, "c"_a, "lower"_a, "upper"_a, "G"_a.none() = nb::none(),
        "h"_a.none() = nb::none());
  m.def("measure_shapes", &measure_shapes);
}
