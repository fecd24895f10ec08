// What an episode is measured by.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "person.hpp"

namespace handmap {

// FlagRows of samples, `width` of each.
struct FlagRows {
  const bool* data;
  size_t width;
  const bool* row(size_t t) const { return data + t * width; }
};

// Measures a recording, and what a robot did of it. Tables have a row for each sample.
struct EpisodeMeter {
  size_t count;
  const double* time;
  const double* landmarks;
  const bool* seen;      // by the tracker
  const bool* followed;  // by the robot
  const double* errors;  // of `points` points a sample
  size_t points;
  FlagRows at_limit, at_speed_limit;
  const double* q;
  size_t joints;

  double longest_gap() const {
    Vector steps;
    for (size_t t = 1; t < count; ++t) steps.push_back(time[t] - time[t - 1]);
    double longest = 0.0;
    size_t first = count, last = 0;
    for (size_t t = 0; t < count; ++t) {
      if (!seen[t]) continue;
      if (first == count) first = t;
      else longest = std::max(longest, time[t] - time[last]);
      last = t;
    }
    const double inside = longest - (steps.empty() ? 0.0 : median(steps));
    return std::max({0.0, inside, time[first] - time[0], time[count - 1] - time[last]});
  }

  double bone_variation() const {
    double sum = 0.0;
    Vector bones;
    for (int k = 0; k < 20; ++k) {
      if (k % 4 == 3) continue;
      bones.clear();
      for (size_t t = 0; t < count; ++t) {
        const double *a = landmarks + 63 * t + 3 * (k + 1), *b = a + 3;
        if (seen[t]) bones.push_back(norm({b[0] - a[0], b[1] - a[1], b[2] - a[2]}));
      }
      const double mean = mean_of(bones);
      for (double& bone : bones) bone = (bone - mean) * (bone - mean);
      sum += std::sqrt(mean_of(bones)) / mean;
    }
    return sum / 15.0;
  }

  // Errors of the samples that the robot followed [mm].
  Vector reaches() const {
    Vector found;
    for (size_t t = 0; t < count; ++t)
      for (size_t k = 0; followed[t] && k < points; ++k)
        found.push_back(1e3 * errors[t * points + k]);
    return found;
  }

  // The share of flags, or of samples with one, among the samples that the robot followed.
  double share(const FlagRows& flags, bool is_by_sample) const {
    size_t set = 0, all = 0;
    for (size_t t = 0; t < count; ++t) {
      if (!followed[t]) continue;
      const auto found = std::count(flags.row(t), flags.row(t) + flags.width, true);
      set += is_by_sample ? found > 0 : found;
      all += is_by_sample ? 1 : flags.width;
    }
    return static_cast<double>(set) / static_cast<double>(all);
  }

  // RMS of the third derivative by divided differences; NaN without four samples in a row.
  double jerk() const {
    Vector differences(q, q + count * joints);
    for (size_t k = 1; k <= 3 && k < count; ++k)
      for (size_t t = 0; t + k < count; ++t)
        for (size_t j = 0; j < joints; ++j) {
          double& value = differences[t * joints + j];
          value = k * (differences[(t + 1) * joints + j] - value) / (time[t + k] - time[t]);
        }
    double sum = 0.0;
    size_t all = 0;
    for (size_t t = 0; t + 3 < count; ++t) {
      if (!(followed[t] && followed[t + 1] && followed[t + 2] && followed[t + 3])) continue;
      for (size_t j = 0; j < joints; ++j)
        sum += differences[t * joints + j] * differences[t * joints + j];
      all += joints;
    }
    return all ? std::sqrt(sum / static_cast<double>(all)) : std::nan("");
  }

  static double mean_of(const Vector& values) {
    double sum = 0.0;
    for (const double value : values) sum += value;
    return sum / static_cast<double>(values.size());
  }
};

}  // namespace handmap
