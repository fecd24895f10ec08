// What Python sees of the core: flat arrays in, one call a sample.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "build.hpp"
#include "tracks.hpp"

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

Landmarks landmarks_of(const nb::handle& given) {
  const Array numbers = nb::cast<Array>(given);
  expect_size(numbers, 3 * kLandmarks, "landmarks");
  Landmarks points;
  for (int i = 0; i < kLandmarks; ++i)
    points[i] = {numbers.data()[3 * i], numbers.data()[3 * i + 1], numbers.data()[3 * i + 2]};
  return points;
}

// A new array of Python with given numbers.
nb::object numbers_of(const double* from, size_t rows, size_t columns) {
  double* to = new double[rows * columns];
  std::copy(from, from + rows * columns, to);
  nb::capsule owner(to, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  if (columns == 1) return nb::cast(nb::ndarray<nb::numpy, double>(to, {rows}, owner));
  return nb::cast(nb::ndarray<nb::numpy, double>(to, {rows, columns}, owner));
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
      now, numbers_of(&track.points[0].x, kLandmarks, 3), numbers_of(&track.centre.x, 3, 1),
      numbers_of(track.lengths.data(), kFixed, 1), numbers_of(&still.x, 3, 1),
      numbers_of(&still.x, 3, 1), numbers_of(&track.bending[0].x, kLandmarks, 3));
}

nb::object change_of(const nb::tuple& before, const nb::tuple& sample, double dt) {
  Track moved = track_of(sample);
  const Change change = change_between(track_of(before), moved, dt);
  const nb::object track = guard().attr("Track")(
      sample[0], sample[1], sample[2], sample[3], numbers_of(&moved.velocity.x, 3, 1),
      numbers_of(&moved.turning.x, 3, 1), numbers_of(&moved.bending[0].x, kLandmarks, 3), dt);
  return guard().attr("Change")(track, numbers_of(change.sizes, 4, 1), change.is_turned,
                                change.is_alone, change.is_too_fast);
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

Vector margins_of(const Ik& ik, const std::optional<Array>& margins) {
  if (!margins) return {};
  if (!ik.pairs || margins->size() != ik.pairs->pairs.size())
    throw std::invalid_argument("wrong size of margins");
  return vector_of(*margins);
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
  Result result;
  ik.solve(goal, dt, margins_of(ik, margins), speed, result);
  return tuple_of(ik, result);
}

// Many samples of one goal each, one after the other and without the GIL, from where the hand is.
// Returns for each sample its configuration, displacement, stop times and status, one after the other.
nb::ndarray<nb::numpy, double> solve_many(Ik& ik, const Array& points,
                                          const std::optional<Array>& wrists, const Array& dt,
                                          const Array& speed, const std::optional<Array>& margins,
                                          const Postures& postures) {
  const size_t count = dt.size(), m = 3 * ik.tree.points.size();
  expect_size(points, count * m, "points");
  expect_size(speed, count, "speed");
  if (wrists) expect_size(*wrists, 16 * count, "wrists");
  Goal goal;
  goal.points.resize(ik.tree.points.size());
  goal.has_wrist = wrists.has_value();
  goal.postures = postures_of(ik, postures);
  const Vector kept = margins_of(ik, margins);
  double* to;
  auto numbers = array_of(count * (ik.tree.nq + 2 * ik.tree.size + 1), to);
  nb::gil_scoped_release released;
  Result result;
  for (size_t i = 0; i < count; ++i) {
    const double* from = points.data() + i * m;
    for (size_t k = 0; k < goal.points.size(); ++k)
      goal.points[k] = {from[3 * k], from[3 * k + 1], from[3 * k + 2]};
    if (wrists) goal.wrist = pose_of(wrists->data() + 16 * i);
    ik.solve(goal, dt.data()[i], kept, speed.data()[i], result);
    for (const Vector* part : {&ik.motion.q, &ik.motion.displacement, &ik.motion.stop_times})
      to = std::copy(part->begin(), part->end(), to);
    *to++ = static_cast<double>(result.status);
  }
  return numbers;
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
      .def("solve_many", &solve_many, "points"_a, "wrists"_a.none(), "dt"_a, "speed"_a,
           "margins"_a.none(), "postures"_a)
      .def("follow", &follow, "map"_a, "points"_a, "wrist"_a.none(), "dt"_a, "speed"_a,
           "postures"_a);
  nb::class_<TargetMap>(m, "TargetMap").def("targets", &targets, "points"_a, "wrist"_a.none());
  nb::class_<TeleoperationMap, TargetMap>(m, "TeleoperationMap")
      .def("__init__", &make_teleoperation);
  nb::class_<HomogeneousMap, TargetMap>(m, "HomogeneousMap").def("__init__", &make_homogeneous);
  nb::class_<LandmarkReader>(m, "LandmarkReader")
      .def("__init__", &make_reader)
      .def("read", &read_landmarks);
  m.def("is_zero", [](const nb::object& landmarks) { return is_zero(landmarks_of(landmarks)); });
  m.def("first_track", &first_track_of);
  m.def("change_between", &change_of);
  m.def("solve_qp", &solve_qp, "H"_a, "c"_a, "lower"_a, "upper"_a, "G"_a.none() = nb::none(),
        "h"_a.none() = nb::none());
  m.def("measure_shapes", &measure_shapes);
}
