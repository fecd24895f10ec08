// What is measured of a person's hand in many samples: see handmap_qp/human/measure.py.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "targets.hpp"

namespace handmap {

// The median; an even count has the mean of the two in the middle. Changes the order of `values`.
inline double median(Vector& values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  if (values.size() % 2) return *middle;
  return (*std::max_element(values.begin(), middle) + *middle) / 2.0;
}

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

struct PersonShape {
  std::vector<Vec3> bases;
  std::array<double, 5> rolls{};
};

class PersonMeter {
 public:
  double bent;        // see measure._BENT
  size_t fewest_bent;
  double largest_roll;

  // Of landmarks of a right hand, 21 a sample; `palm` is the standard one.
  PersonShape measure(const std::vector<Vec3>& landmarks, std::vector<Vec3> palm) const {
    const size_t count = landmarks.size() / 21;
    std::vector<Vec3> palms, laid(palms.size());
    for (size_t t = 0; t < count; ++t)
      for (const int i : kPalm) palms.push_back(landmarks[21 * t + i]);
    laid.resize(palms.size());
    for (int round = 0; round < 3; ++round) {
      lay(palms, palm, palms, laid);
      palm = medians(laid, palm.size());
      const Vec3 wrist = palm[0];
      for (Vec3& point : palm) point -= wrist;
    }
    laid.resize(landmarks.size());
    lay(palms, palm, landmarks, laid);
    std::vector<Vec3> first;
    for (size_t t = 0; t < count; ++t)
      for (int finger = 0; finger < 5; ++finger) first.push_back(laid[21 * t + 1 + 4 * finger]);
    PersonShape shape{medians(first, 5), {}};
    for (int finger = 1; finger < 5; ++finger) shape.rolls[finger] = roll(laid, finger);
    return shape;
  }

 private:
  // Take the points of each sample along as its palm is laid onto another one.
  static void lay(const std::vector<Vec3>& palms, const std::vector<Vec3>& onto,
                  const std::vector<Vec3>& points, std::vector<Vec3>& laid) {
    const size_t n = onto.size(), count = palms.size() / n, each = points.size() / count;
    std::vector<Vec3> palm(n);
    for (size_t t = 0; t < count; ++t) {
      std::copy_n(palms.begin() + n * t, n, palm.begin());
      const Pose pose = rigid_fit(palm, onto);
      for (size_t i = each * t; i < each * (t + 1); ++i) laid[i] = pose * points[i];
    }
  }

  double roll(const std::vector<Vec3>& laid, int finger) const {
    Vector angles;
    for (size_t t = 0; t < laid.size(); t += 21) {
      const Vec3* joints = laid.data() + t + 1 + 4 * finger;
      const Vec3 proximal = joints[1] - joints[0], beyond = joints[3] - joints[1];
      const Vec3 normal = cross(proximal, beyond);
      if (norm(normal) > bent * norm(proximal) * norm(beyond))
        angles.push_back(std::atan2(normal.z, -normal.x));
    }
    if (angles.size() < fewest_bent) return 0.0;
    return std::clamp(median(angles), -largest_roll, largest_roll);
  }
};

}  // namespace handmap
