// How noisy measured points are.
//
// A hand hardly changes its velocity between samples, and white noise does: the median change over all
// points is noise, whatever one of them does.
#pragma once

#include <algorithm>
#include <cmath>

#include "order.hpp"

namespace handmap {

// Median length of vectors of three standard normal numbers.
constexpr double kNormalLength = 1.538;
// Share of a sample in the running estimate of noise.
constexpr double kNoiseShare = 0.1;
// A sample counts as no more than this many times the estimate, so that a fault hardly counts. An
// estimate below the least rises as one of that size, so that noise is soon learnt [m].
constexpr double kMostNoise = 3.0, kLeastNoise = 3e-4;

// The change of velocity over the noise that makes it, from the last two steps of time [1/s].
inline double change_rate(double dt, double former) {
  return std::hypot(1.0 / dt, 1.0 / former, 1.0 / dt + 1.0 / former);
}

// The noise of points [m], of sizes of the changes of their velocities [m/s], which it sorts.
inline double noise_of(double* changes, size_t count, double rate) {
  return upper_median(changes, count) / (kNormalLength * rate);
}

// The running estimate of noise after a sample, from that before [m].
inline double learnt_noise(double noise, double seen) {
  const double most = kMostNoise * std::max(noise, kLeastNoise);
  return noise + kNoiseShare * (std::min(seen, most) - noise);
}

}  // namespace handmap
