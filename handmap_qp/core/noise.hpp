// How noisy measured points are: see handmap_qp/trackers/hand_geometry.py, whose names these are.
#pragma once

#include <algorithm>
#include <cmath>

#include "order.hpp"

namespace handmap {

// Numbers of Python.
struct NoiseRules {
  double normal, share, most, least;
};

inline double change_rate(double dt, double former) {
  return std::hypot(1.0 / dt, 1.0 / former, 1.0 / dt + 1.0 / former);
}

// It sorts the sizes of the changes.
inline double noise_of(const NoiseRules& rules, double* changes, int count, double rate) {
  return upper_median(changes, count) / (rules.normal * rate);
}

inline double learnt_noise(const NoiseRules& rules, double noise, double seen) {
  const double most = rules.most * std::max(noise, rules.least);
  return noise + rules.share * (std::min(seen, most) - noise);
}

}  // namespace handmap
