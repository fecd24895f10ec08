// Measures of persons and recordings, and the parts of the core that tests compare.
#include <nanobind/stl/optional.h>
#include <optional>

#include "bind.hpp"
#include "arrays.hpp"
#include "build_guard.hpp"
#include "handmap/episode.hpp"
#include "handmap/pair_models.hpp"
#include "handmap/person.hpp"

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

// Of two shapes in two poses: distance, normal, and the first one's nearest point.
nb::tuple measure_shapes(const nb::bytes& a, const Array& pose_a, const nb::bytes& b,
                         const Array& pose_b) {
  expect_size(pose_a, 16, "pose_a");
  expect_size(pose_b, 16, "pose_b");
  Warm warm{};
  const Found found = measure(shape_of(model_of<ShapeModel>(a)), pose_of(pose_a.data()), shape_of(model_of<ShapeModel>(b)),
                              pose_of(pose_b.data()), warm);
  return nb::make_tuple(found.distance,
                        nb::make_tuple(found.normal.x, found.normal.y, found.normal.z),
                        nb::make_tuple(found.point.x, found.point.y, found.point.z));
}

// Of landmarks of a right hand (T, 21, 3), the palm's landmarks of the standard hand (5, 3), and the
// largest roll of a finger [rad]: first joints (5, 3), rolls (5,), and the weight of the little finger's
// knuckle where the palm is fitted.
nb::tuple measure_shape(const Array& landmarks, const Array& palm, double largest_roll) {
  expect_size(palm, 15, "palm");
  expect(largest_roll >= 0.0, "largest_roll is negative");
  if (landmarks.size() == 0 || landmarks.size() % (3 * kLandmarks))
    throw std::invalid_argument("wrong size of landmarks");
  const PersonShape shape =
      PersonMeter{largest_roll}.measure(points_of(landmarks), points_of(palm));
  return nb::make_tuple(array_of({5, 3}, &shape.bases[0].x), array_of({5}, shape.rolls.data()),
                        shape.little_weight);
}

size_t rows_of(const Flags& flags) {
  expect(flags.ndim() == 2, "columns of wrong shapes");
  return flags.shape(0);
}

// Measures of a recording and of a robot that followed it, by name: which samples it followed, the
// errors of its points, joints at limits of position and of speed, and joint positions.
nb::dict measure_episode(const Samples& samples, const Flags& followed, const Array& errors,
                         const Flags& at_limit, const Flags& at_speed, const Array& q) {
  const size_t count = samples.count;
  expect(errors.ndim() == 2 && q.ndim() == 2, "columns of wrong shapes");
  for (const size_t size :
       {errors.shape(0), q.shape(0), followed.size(), rows_of(at_limit), rows_of(at_speed)})
    expect(size == count, "columns of different lengths");
  const bool* follows = followed.data();
  expect(samples.valid_count() > 0 && std::count(follows, follows + count, true) > 0,
         "no sample was followed");
  const EpisodeMeter meter{count, samples.times(), samples.landmarks(), samples.valid(), follows,
                           errors.data(), errors.shape(1), {at_limit.data(), at_limit.shape(1)},
                           {at_speed.data(), at_speed.shape(1)}, q.data(), q.shape(1)};
  Vector reaches = meter.reaches();
  nb::dict found;
  found["valid"] = static_cast<double>(samples.valid_count()) / static_cast<double>(count);
  found["longest_gap_s"] = meter.longest_gap();
  found["bone_variation"] = meter.bone_variation();
  found["reach_mm"] = EpisodeMeter::mean_of(reaches);
  found["reach_p95_mm"] = percentile_of(reaches, 95.0);
  found["saturation"] = meter.share(meter.at_limit, false);
  found["speed_limited"] = meter.share(meter.at_speed_limit, true);
  found["jerk"] = meter.jerk();
  return found;
}

double smallest_gap_of(const Array& time, const Array& landmarks, double median_time,
                       double percentile) {
  expect_size(landmarks, 3 * kLandmarks * time.size(), "landmarks");
  if (time.size() == 0) throw std::invalid_argument("no samples");
  expect(median_time > 0.0, "median_time is not positive");
  expect(percentile >= 0.0 && percentile <= 100.0, "percentile is not one");
  return smallest_gap(time.data(), points_of(landmarks), median_time, percentile);
}

// Of landmarks (T, 21, 3) or of one sample.
std::vector<Landmarks> hands_of(const Array& landmarks) {
  expect(landmarks.size() % (3 * kLandmarks) == 0, "wrong size of landmarks");
  std::vector<Landmarks> hands;
  for (size_t at = 0; at < landmarks.size(); at += 3 * kLandmarks)
    hands.push_back(landmarks_of(landmarks.data() + at));
  return hands;
}

Distances own_distances(const Array& landmarks) {
  static const LandmarkOrders ours({{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20}});
  const std::vector<Landmarks> hands = hands_of(landmarks);
  expect(!hands.empty(), "no samples");
  Distances found;
  found.measure(ours.pairs.data(), 0, kPairs, hands.data(), static_cast<int>(hands.size()));
  return found;
}

// A row for each sample: total, and fingers.
nb::object palmar_evidence_of(const Array& landmarks) {
  Vector rows;
  for (const Landmarks& hand : hands_of(landmarks)) {
    const PalmarEvidence evidence = palmar_evidence(hand);
    rows.insert(rows.end(), {evidence.total, evidence.fingers});
  }
  return array_of({rows.size() / 2, 2}, rows.data());
}

nb::object palm_axes_of(const Array& landmarks, double sign) {
  Vector rows;
  for (const Landmarks& hand : hands_of(landmarks)) {
    const Mat3 axes = palm_axes(hand, sign);
    rows.insert(rows.end(), axes.m, axes.m + 9);
  }
  return array_of({rows.size() / 9, 3, 3}, rows.data());
}

nb::object conventions() {
  Vector rows;
  for (const Mat3& axes : wrist_conventions()) rows.insert(rows.end(), axes.m, axes.m + 9);
  return array_of({kConventions, 3, 3}, rows.data());
}

Mat3 matrix_of(const Array& a) {
  expect_size(a, 9, "rotation");
  Mat3 found;
  std::copy(a.data(), a.data() + 9, found.m);
  return found;
}

}  // namespace

void bind_measures(nb::module_& m) {
  m.def("measure_shape", &measure_shape, "landmarks"_a, "palm"_a, "largest_roll"_a);
  m.def("log3", [](const Array& rotation) {
    const Vec3 turn = log3(matrix_of(rotation));
    return array_of({3}, &turn.x);
  }, "rotation"_a);
  m.def("exp3", [](const Array& turn) {
    expect_size(turn, 3, "turn");
    return array_of({3, 3}, exp3(points_of(turn)[0]).m);
  }, "turn"_a);
  m.def("quat_xyzw", [](const Array& rotation) {
    const Quat q = quat_of(matrix_of(rotation));
    return array_of(Vector{q.x, q.y, q.z, q.w});
  }, "rotation"_a);
  m.def("smoothstep", [](const Array& x) {
    Vector shares = vector_of(x);
    for (double& each : shares) each = smoothstep(each);
    return array_of(shares);
  }, "x"_a);
  m.def("smallest_gap", &smallest_gap_of, "time"_a, "landmarks"_a, "median_time"_a,
        "percentile"_a);
  m.def("log_size", [](const Array& landmarks) { return own_distances(landmarks).log_size(); },
        "landmarks"_a);
  m.def("misfit", [](const Array& landmarks) { return misfit(own_distances(landmarks), true); },
        "landmarks"_a);
  m.def("palmar_evidence", &palmar_evidence_of, "landmarks"_a);
  m.def("palm_axes", &palm_axes_of, "landmarks"_a, "sign"_a);
  m.attr("WRIST_CONVENTIONS") = conventions();
  m.def("measure_episode", &measure_episode, "samples"_a, "followed"_a, "point_error"_a, "at_limit"_a,
        "at_speed_limit"_a, "q"_a);
  m.def("solve_qp", &solve_qp, "H"_a, "c"_a, "lower"_a, "upper"_a, "G"_a.none() = nb::none(),
        "h"_a.none() = nb::none());
  m.def("measure_shapes", &measure_shapes, "a"_a, "pose_a"_a, "b"_a, "pose_b"_a);
}

}  // namespace handmap
