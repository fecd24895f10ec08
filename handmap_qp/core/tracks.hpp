// How a hand has moved from one sample of a tracker to the next: see handmap_qp/stream/guard.py, whose
// names these are.
#pragma once

#include <array>

#include "targets.hpp"

namespace handmap {

constexpr int kLandmarks = 21;
// Pairs of landmarks whose distance does not change.
constexpr int kFixed = 23;
constexpr int kStarts[kFixed] = {0, 1,  2,  3,  0,  5,  6,  7,  0,  9, 10, 11,
                                 0, 13, 14, 15, 0, 17, 18, 19, 5, 9, 13};
constexpr int kEnds[kFixed] = {1,  2,  3,  4,  5,  6,  7,  8,  9, 10, 11, 12,
                               13, 14, 15, 16, 17, 18, 19, 20, 9, 13, 17};
constexpr double kFlip = 1.0471975511965976;  // 60 degrees
constexpr double kZeroSize = 0.001;
constexpr double kMirror = 1e-4;
constexpr double kFastest[3] = {6.0, 40.0, 6.0};
constexpr double kAlone = 3.0;

using Landmarks = std::array<Vec3, kLandmarks>;

struct Track {
  Landmarks points;  // from the palm's centre
  Vec3 centre;
  std::array<double, kFixed> lengths;
  Vec3 velocity, turning;
  Landmarks bending{};
  double dt = 0.0;
};

struct Change {
  double sizes[4];
  bool is_turned, is_alone, is_too_fast;
};

inline Vec3 palm_centre(const Landmarks& points) {
  Vec3 centre;
  for (const int i : kPalm) centre += 0.2 * points[i];
  return centre;
}

// Whether landmarks lie in one place, or all but one at the origin.
inline bool is_zero(const Landmarks& points) {
  const Vec3 centre = palm_centre(points);
  double sum = 0.0;
  for (const int i : kPalm) sum += dot(points[i] - centre, points[i] - centre);
  int seen = 0;
  for (const Vec3& p : points) seen += p.x != 0.0 || p.y != 0.0 || p.z != 0.0;
  return std::sqrt(sum / 5.0) < kZeroSize || seen < kLandmarks - 1;
}

inline Track first_track(const Landmarks& landmarks) {
  Track track;
  track.centre = palm_centre(landmarks);
  for (int i = 0; i < kLandmarks; ++i) track.points[i] = landmarks[i] - track.centre;
  for (int k = 0; k < kFixed; ++k)
    track.lengths[k] = norm(landmarks[kEnds[k]] - landmarks[kStarts[k]]);
  return track;
}

// Measure the motion from a track to a sample, which takes it over.
inline Change change_between(const Track& track, Track& sample, double dt) {
  Mat3 palm = 0.0 * Mat3{}, whole = palm;
  for (const int i : kPalm) palm = palm + outer(sample.points[i], track.points[i]);
  for (int i = 0; i < kLandmarks; ++i) whole = whole + outer(sample.points[i], track.points[i]);
  const Mat3 rotation = nearest_rotation(palm);
  const Vec3 turn = log3(rotation);
  const bool is_known = track.dt > 0.0;
  const double span = is_known ? 0.5 * (dt + track.dt) : dt;
  sample.velocity = (1.0 / dt) * (sample.centre - track.centre);
  sample.turning = (1.0 / dt) * turn;
  sample.dt = dt;
  Change change{};
  double fastest = 0.0, second = 0.0, fingers = 0.0;
  for (int i = 0; i < kLandmarks; ++i) {
    const Vec3 moved = (1.0 / dt) * (tmul(rotation, sample.points[i]) - track.points[i]);
    sample.bending[i] = rotation * moved;
    fastest = std::max(fastest, norm(moved));
    const double slip = is_known ? norm(moved - track.bending[i]) / span : 0.0;
    second = std::max(second, std::min(slip, fingers));
    fingers = std::max(fingers, slip);
  }
  if (is_known) {
    change.sizes[0] = norm(sample.velocity - track.velocity) / span;
    change.sizes[1] = norm(sample.turning - track.turning) / span;
    change.sizes[2] = fingers;
  }
  for (int k = 0; k < kFixed; ++k)
    change.sizes[3] = std::max(change.sizes[3], std::abs(sample.lengths[k] - track.lengths[k]));
  // A reflection that lays one hand better on the other than any rotation does.
  const double mirrored = svd3(whole).s[2];
  change.is_turned = norm(turn) > kFlip || mirrored < -kMirror;
  change.is_alone = fingers > kAlone * second;
  change.is_too_fast = norm(sample.velocity) > kFastest[0] || norm(turn) / dt > kFastest[1] ||
                       fastest > kFastest[2];
  return change;
}

}  // namespace handmap
