// What is measured of a person's hand in many samples.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "order.hpp"
#include "targets.hpp"

namespace handmap {

// `samples` of `count` points each; medians of each coordinate.
inline std::vector<Vec3> medians(const std::vector<Vec3>& samples, size_t count) {
  std::vector<Vec3> found(count);
  Vector column(samples.size() / count);
  for (size_t i = 0; i < count; ++i)
    for (int axis = 0; axis < 3; ++axis) {
      for (size_t t = 0; t < column.size(); ++t) column[t] = samples[t * count + i][axis];
      found[i][axis] = median(column);
    }
  return found;
}

// Lays points onto others like `rigid_fit`. The axes in which the shape of `onto` is spread hardly
// differ from sample to sample, so the turns that find them begin at the last ones.
class Layer {
 public:
  Pose fit(const Vec3* points, const std::vector<Vec3>& onto, const Vector& weights) {
    return rigid_fit(points, onto.data(), weights, [this](const Mat3& A) { return rotation(A); });
  }

 private:
  Mat3 rotation(const Mat3& A) {
    axes_[0] *= 1.0 / norm(axes_[0]);
    axes_[2] = cross(axes_[0], axes_[1]);
    axes_[2] *= 1.0 / norm(axes_[2]);
    axes_[1] = cross(axes_[2], axes_[0]);
    Vec3 a[3];
    for (int i = 0; i < 3; ++i) a[i] = tmul(A, axes_[i]);
    for (int sweep = 0; sweep < 30; ++sweep) {
      bool turned = false;
      for (int p = 0; p < 2; ++p)
        for (int q = p + 1; q < 3; ++q) turned |= turn(a[p], a[q], axes_[p], axes_[q]);
      if (!turned) break;
    }
    int first = 0, least = 0;
    for (int i = 1; i < 3; ++i) {
      if (dot(a[i], a[i]) > dot(a[first], a[first])) first = i;
      if (dot(a[i], a[i]) <= dot(a[least], a[least])) least = i;
    }
    // Without an order of lengths, as of NaN, they are the same, and there is no second one.
    if (first == least) return nearest_rotation(A);
    const int second = 3 - first - least;
    const double s0 = norm(a[first]), s1 = norm(a[second]);
    if (!(s1 > 1e-9 * s0)) return nearest_rotation(A);
    const Vec3 u[2] = {axes_[first], axes_[second]};
    const Vec3 v[2] = {(1.0 / s0) * a[first], (1.0 / s1) * a[second]};
    return outer(u[0], v[0]) + outer(u[1], v[1]) + outer(cross(u[0], u[1]), cross(v[0], v[1]));
  }

  // Turn two columns until they are orthogonal, and their axes along.
  static bool turn(Vec3& a, Vec3& b, Vec3& axis_a, Vec3& axis_b) {
    const double aa = dot(a, a), bb = dot(b, b), ab = dot(a, b);
    if (!(ab * ab > 1e-32 * aa * bb)) return false;
    const double zeta = (bb - aa) / (2.0 * ab);
    const double t = std::copysign(1.0, zeta) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
    const double c = 1.0 / std::sqrt(1.0 + t * t), s = c * t;
    const Vec3 x = a, y = axis_a;
    a = c * x - s * b;
    b = s * x + c * b;
    axis_a = c * y - s * axis_b;
    axis_b = s * y + c * axis_b;
    return true;
  }

  Vec3 axes_[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
};

// A percentile of the smallest gap between the tips of thumb and finger [m]. Gaps are medians over a time
// [s] first, which single outliers and noise hardly move.
inline double smallest_gap(const double* time, const std::vector<Vec3>& landmarks,
                           double median_time, double percentile) {
  const int count = static_cast<int>(landmarks.size() / 21);
  Vector steps;
  for (int t = 1; t < count; ++t) steps.push_back(time[t] - time[t - 1]);
  const double period = steps.empty() ? median_time : median(steps);
  const double wanted = 2.0 * std::nearbyint(0.5 * median_time / std::max(period, 1e-6)) + 1.0;
  const int width = static_cast<int>(std::min<double>(std::max(1.0, wanted), count));
  const int before = width / 2;
  Vector smallest(count, kInfinity), gaps(count), window(width);
  for (int tip = 8; tip < 21; tip += 4) {
    for (int t = 0; t < count; ++t)
      gaps[t] = norm(landmarks[21 * t + tip] - landmarks[21 * t + 4]);
    for (int t = 0; t < count; ++t) {
      for (int i = 0; i < width; ++i) window[i] = gaps[std::clamp(t - before + i, 0, count - 1)];
      const double gap = nth_smallest(window.data(), window.size(), before);
      smallest[t] = std::isnan(gap) ? gap : std::min(smallest[t], gap);
    }
  }
  return percentile_of(smallest, percentile);
}

struct PersonShape {
  std::vector<Vec3> bases;
  std::array<double, 5> rolls{};
  double little_weight = 1.0;
};

// Sine of the angle between proximal bone and the line from PIP to tip, above which a finger spans a
// plane: of 15 degrees.
constexpr double kBentSine = 0.25881904510252074;
// Bent samples that a finger's roll needs.
constexpr size_t kFewestBent = 20;
// Spread that landmarks of a palm have at least: they are not told apart below it [m].
constexpr double kSteadySpread = 5e-4;
// Least weight of the little finger's knuckle where the palm is fitted.
constexpr double kLeastKnuckleWeight = 0.02;
// Rounds in which shape and weight of the palm are found.
constexpr int kRounds = 5;
// Samples that the spread of knuckles is measured in, at most.
constexpr size_t kSpreadSamples = 64;

class PersonMeter {
 public:
  double largest_roll;  // of a finger [rad]

  // Of landmarks of a right hand, 21 a sample; `palm` is the standard one. They are laid where they are,
  // because those of an hour take 54 MB.
  PersonShape measure(std::vector<Vec3> laid, std::vector<Vec3> palm) const {
    const size_t count = laid.size() / 21;
    std::vector<Vec3> palms;
    palms.reserve(palm.size() * count);
    for (size_t t = 0; t < count; ++t)
      for (const int i : kPalm) palms.push_back(laid[21 * t + i]);
    Vector weights(palm.size(), 1.0);
    palm = common_shape(palms, palm, weights);
    for (int round = 0; round < kRounds; ++round) {
      const double weight = little_weight(palms, palm, weights);
      if (weight == weights.back()) break;
      weights.back() = weight;
      palm = common_shape(palms, palm, weights);
    }
    lay(palms, palm, weights, laid, laid);
    std::vector<Vec3> first;
    first.reserve(5 * count);
    for (size_t t = 0; t < count; ++t)
      for (int finger = 0; finger < 5; ++finger) first.push_back(laid[21 * t + 1 + 4 * finger]);
    PersonShape shape{medians(first, 5), {}, weights.back()};
    for (int finger = 1; finger < 5; ++finger) shape.rolls[finger] = roll(laid, finger);
    return shape;
  }

 private:
  // The shape that palms have in common, from a first guess: generalised Procrustes analysis, which lays
  // every sample on the median shape, then takes the median again. Three rounds are enough to converge.
  static std::vector<Vec3> common_shape(const std::vector<Vec3>& palms, std::vector<Vec3> palm,
                                        const Vector& weights) {
    std::vector<Vec3> laid(palms.size());
    for (int round = 0; round < 3; ++round) {
      lay(palms, palm, weights, palms, laid);
      palm = medians(laid, palm.size());
      const Vec3 wrist = palm[0];
      for (Vec3& point : palm) point -= wrist;
    }
    return palm;
  }

  // The weight of the little finger's knuckle in the fit of the palm. The fifth metacarpal moves on the
  // palm, the second does not, and noise moves both knuckles alike. So the weight falls where the little
  // finger's knuckle moves more than the index finger's, seen from all other landmarks.
  double little_weight(const std::vector<Vec3>& palms, const std::vector<Vec3>& palm,
                       const Vector& weights) const {
    const size_t n = palm.size(), count = palms.size() / n, stride = (count + kSpreadSamples - 1) / kSpreadSamples;
    std::vector<Vec3> some;
    for (size_t t = 0; t < count; t += stride)
      some.insert(some.end(), palms.begin() + n * t, palms.begin() + n * (t + 1));
    const double ratio = (spread(some, palm, weights, 1) + kSteadySpread) /
                         (spread(some, palm, weights, n - 1) + kSteadySpread);
    return std::clamp(ratio * ratio * ratio * ratio, kLeastKnuckleWeight, 1.0);
  }

  // How far a landmark moves on palms that are laid onto a shape by their other landmarks.
  static double spread(const std::vector<Vec3>& palms, const std::vector<Vec3>& palm,
                       Vector weights, size_t landmark) {
    const size_t n = palm.size();
    weights[landmark] = 0.0;
    std::vector<Vec3> laid(palms.size()), places;
    lay(palms, palm, weights, palms, laid);
    for (size_t i = landmark; i < laid.size(); i += n) places.push_back(laid[i]);
    const Vec3 usual = medians(places, 1)[0];
    double sum = 0.0;
    for (const Vec3& place : places) sum += dot(place - usual, place - usual);
    return std::sqrt(sum / static_cast<double>(places.size()));
  }

  // Take the points of each sample along as its palm is laid onto another one; in place if `laid` is them.
  static void lay(const std::vector<Vec3>& palms, const std::vector<Vec3>& onto,
                  const Vector& weights, const std::vector<Vec3>& points,
                  std::vector<Vec3>& laid) {
    const size_t n = onto.size(), count = palms.size() / n, each = points.size() / count;
    Layer layer;
    for (size_t t = 0; t < count; ++t) {
      const Pose pose = layer.fit(palms.data() + n * t, onto, weights);
      for (size_t i = each * t; i < each * (t + 1); ++i) laid[i] = pose * points[i];
    }
  }

  // The roll of a finger about its bone. The bones of a bent finger span a plane whose normal is its
  // flexion axis. Abduction turns it about the axis that rolls with it, so that the ratio of its x and z
  // parts is that of the roll. The thumb's bones bend about two axes, so it has none.
  double roll(const std::vector<Vec3>& laid, int finger) const {
    Vector angles;
    for (size_t t = 0; t < laid.size(); t += 21) {
      const Vec3* joints = laid.data() + t + 1 + 4 * finger;
      const Vec3 proximal = joints[1] - joints[0], beyond = joints[3] - joints[1];
      const Vec3 normal = cross(proximal, beyond);
      if (norm(normal) > kBentSine * norm(proximal) * norm(beyond))
        angles.push_back(std::atan2(normal.z, -normal.x));
    }
    if (angles.size() < kFewestBent) return 0.0;
    return std::clamp(median(angles), -largest_roll, largest_roll);
  }
};

}  // namespace handmap
