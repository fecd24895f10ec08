// Measures of persons and recordings, and the parts of the core that tests compare.
#include <nanobind/stl/optional.h>
#include <optional>

#include "bind.hpp"
#include "arrays.hpp"
#include "build_guard.hpp"
#include "episode.hpp"
#include "person.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

nb::tuple solve_qp(const Array& H, const Array& c, const Array& lower, const Array& upper,
                   const std::optional<Array>& G, const std::optional<Array>& h) {
  const int n = static_cast<int>(c.size());
  expect_size(H, c.size() * c.size(), "H");
  expect_size(lower, c.size(), "lower");
  expect_size(upper, c.size(), "upper");
  if (G.has_value() != h.has_value()) throw std::invalid_argument("G and h go together");
  if (G) expect_size(*G, h->size() * c.size(), "G");
  Qp qp;
  const bool found = qp.solve(n, H.data(), c.data(), lower.data(), upper.data(),
                              h ? static_cast<int>(h->size()) : 0, G ? G->data() : nullptr,
                              h ? h->data() : nullptr);
  return nb::make_tuple(found, array_of(qp.x), qp.iterations);
}

// Of two shapes of coal in two poses: distance, normal, and the first one's nearest point.
nb::tuple measure_shapes(const nb::object& a, const Array& pose_a, const nb::object& b,
                         const Array& pose_b) {
  expect_size(pose_a, 16, "pose_a");
  expect_size(pose_b, 16, "pose_b");
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
                          constants.get<double>("LARGEST_ROLL"),
                          constants.get<double>("_STEADY"),
                          constants.get<double>("_LEAST_WEIGHT"),
                          constants.get<int>("_ROUNDS"),
                          constants.get<size_t>("_FEW")};
  expect_size(palm, 15, "palm");
  if (landmarks.size() == 0 || landmarks.size() % (3 * kLandmarks))
    throw std::invalid_argument("wrong size of landmarks");
  const PersonShape shape = meter.measure(points_of(landmarks), points_of(palm));
  return nb::make_tuple(array_of({5, 3}, &shape.bases[0].x), array_of({5}, shape.rolls.data()),
                        shape.little_weight);
}

size_t rows_of(const Flags& flags) {
  if (flags.ndim() != 2) throw std::invalid_argument("columns of wrong shapes");
  return flags.shape(0);
}

// See measures.measure_episode.
nb::dict measure_episode(const nb::object& recorded, const nb::object& moved) {
  const Fields recording(recorded), trajectory(moved);
  const Array time = recording.get<Array>("time");
  const size_t count = time.size();
  const Array landmarks = recording.array("landmarks", 3 * kLandmarks * count);
  const Array errors = trajectory.get<Array>("point_error"), q = trajectory.get<Array>("q");
  if (errors.ndim() != 2 || q.ndim() != 2) throw std::invalid_argument("columns of wrong shapes");
  const Flags seen = recording.get<Flags>("valid"),
                  followed = trajectory.get<Flags>("valid"),
                  at_limit = trajectory.get<Flags>("at_limit"),
                  at_speed = trajectory.get<Flags>("at_speed_limit");
  for (const size_t size : {errors.shape(0), q.shape(0), seen.size(), followed.size(),
                            rows_of(at_limit), rows_of(at_speed)})
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

Mat3 matrix_of(const Array& a) {
  expect_size(a, 9, "rotation");
  Mat3 found;
  std::copy(a.data(), a.data() + 9, found.m);
  return found;
}

}  // namespace

void bind_measures(nb::module_& m) {
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
}

}  // namespace handmap
