// The tracker's own wrist poses, checked against the palm that the landmarks show.
#pragma once

#include "finding.hpp"
#include "hand_geometry.hpp"

namespace handmap {

// A wrist's axes in the frame of our wrist, +y distal and +z dorsal: the direction of the fingers, and
// that out of the back of the hand, in the wrist's own axes.
inline Mat3 axes_convention(const Vec3& distal, const Vec3& dorsal) {
  const Vec3 lateral = cross(distal, dorsal);
  return {{lateral.x, lateral.y, lateral.z, distal.x, distal.y, distal.z, dorsal.x, dorsal.y,
           dorsal.z}};
}

// The wrist's axes that known trackers have.
constexpr int kConventions = 6;
inline const std::array<Mat3, kConventions>& wrist_conventions() {
  static const Vec3 x{1, 0, 0}, y{0, 1, 0}, z{0, 0, 1};
  static const std::array<Mat3, kConventions> known = {
      axes_convention(y, z),   // ours
      axes_convention(x, z),   // from Leap's direction and palm normal
      axes_convention(-z, y),  // OpenXR, WebXR
      axes_convention(x, y),   // MANO and SMPL-X, left
      axes_convention(-x, y),  // MANO and SMPL-X, right
      axes_convention(x, -y)};
  return known;
}

// Cosine of the angle between a wrist's axes and those of the palm's landmarks: of 22 degrees, and up to
// 10 in recordings of four trackers.
constexpr double kFarthestAxes = 0.9271838545667874;
// A wrist that follows the palm keeps its rotation to it: cosine of 12 degrees, up to 5 in recordings.
constexpr double kSteadyAxes = 0.9781476007338057;
// A palm that has turned by more (12 degrees) proves a wrist whose rotation to it changed by less than
// this share of the turn: that of a wrist that stands still changes by all of it, an inverse one's by
// twice it.
constexpr double kTurned = 0.20943951023931956, kKeptShare = 0.4;
// Of the wrist's landmark from the pose [m].
constexpr double kFarthestApart = 0.10;
// Samples of a batch, at most.
constexpr int kMostSamples = 32;

inline double cosine(const Mat3& a, const Mat3& b) {
  double sum = 0.0;
  for (int i = 0; i < 9; ++i) sum += a.m[i] * b.m[i];
  return clip((sum - 1.0) / 2.0, -1.0, 1.0);
}

// The palm's rotation: +y to the middle knuckle, 8 to 11 degrees from ours, +z dorsal. The sign is 1 for
// a right hand, -1 for a left one.
inline Mat3 palm_axes(const Landmarks& hand, double sign) {
  const Vec3 dorsal = unit(-sign * cross(hand[5] - hand[0], hand[17] - hand[0]));
  const Vec3 lateral = unit(cross(hand[9] - hand[0], dorsal));
  const Vec3 distal = cross(dorsal, lateral);
  return {{lateral.x, distal.x, dorsal.x, lateral.y, distal.y, dorsal.y, lateral.z, distal.z,
           dorsal.z}};
}

// The mean rotation from wrist to palm, and the cosine between those of both halves of the samples.
struct MeanRelative {
  Mat3 mean;
  double steadiness;

  bool is_steady() const { return steadiness > kSteadyAxes; }
  bool is_known() const {
    for (const Mat3& axes : wrist_conventions())
      if (cosine(axes, mean) > kFarthestAxes) return true;
    return false;
  }
};

// Of the rotations of palms, and those that `read` makes of the wrists'.
template <class Read>
MeanRelative mean_relative(const Mat3* palms, const Mat3* wrists, int n, const Read& read) {
  // Noise of the landmarks cancels in the means.
  Mat3 halves[2] = {0.0 * Mat3{}, 0.0 * Mat3{}};
  for (int t = 0; t < n; ++t) {
    Mat3& half = halves[t < n / 2 ? 0 : 1];
    half = half + transposed(palms[t]) * read(wrists[t]);
  }
  const Mat3 mean = nearest_rotation(halves[0] + halves[1]);
  // Both halves of a single sample are that sample.
  if (n < 2) return {mean, 1.0};
  return {mean, cosine(nearest_rotation(halves[0]), nearest_rotation(halves[1]))};
}

// The usual mistake of a reader that explains the rotations; none if none does.
inline Mistake usual_mistake(const Mat3* palms, const Mat3* wrists, int n) {
  const auto explains = [&](const auto& read) {
    const MeanRelative found = mean_relative(palms, wrists, n, read);
    return found.is_steady() && found.is_known();
  };
  // A layout may have turned the wrist's axes to ours afterwards.
  for (const Mat3& axes : wrist_conventions()) {
    const auto read_wxyz = [&](const Mat3& wrist) {
      const Quat q = quat_of(wrist * axes);
      return rotation_of({q.y, q.z, q.w, q.x});
    };
    if (explains(read_wxyz)) return Mistake::wrist_wxyz;
    const auto read_xyzw = [&](const Mat3& wrist) {
      const Quat q = quat_of(wrist * axes);
      return rotation_of({q.w, q.x, q.y, q.z});
    };
    if (explains(read_xyzw)) return Mistake::wrist_xyzw;
  }
  return explains(transposed) ? Mistake::wrist_inverse : Mistake::none;
}

// Tells whether wrist poses belong to the landmarks, batch by batch.
struct WristCheck {
  // Whether the wrist, in the axes of the human model, has followed a palm that turned by 12 degrees,
  // and has not lost it since.
  bool is_proven = false;
  // Mean palm, and mean rotation from wrist to palm, of the batch to compare with.
  bool has_start = false;
  Mat3 start_palm, start_mean;

  // Compare up to `kMostSamples` wrist poses with the palm that the landmarks show. The rotation from
  // one to the other must be that of a known tracker, or at least be the same in all samples since the
  // start.
  Finding examine(double sign, const Landmarks* hands, const Pose* wrists, int n) {
    const bool was_proven = is_proven;
    is_proven = false;
    double apart[kMostSamples];
    Mat3 palms[kMostSamples], rotations[kMostSamples];
    Mat3 sum = 0.0 * Mat3{};
    for (int t = 0; t < n; ++t) {
      apart[t] = norm(wrists[t].p - hands[t][0]);
      palms[t] = palm_axes(hands[t], sign);
      rotations[t] = wrists[t].R;
      sum = sum + palms[t];
    }
    const double away = upper_median(apart, n);
    if (away > kFarthestApart) return {Mistake::wrist_away, away};
    const auto as_it_is = [](const Mat3& wrist) -> const Mat3& { return wrist; };
    const MeanRelative now = mean_relative(palms, rotations, n, as_it_is);
    const Mat3 palm = nearest_rotation(sum);
    const Mat3 first_palm = has_start ? start_palm : palm;
    const Mat3 first_mean = has_start ? start_mean : now.mean;
    const double kept = cosine(now.mean, first_mean);
    const bool is_steady = now.is_steady() && kept > kSteadyAxes;
    if (!(is_steady && now.is_known())) {
      const Mistake usual = usual_mistake(palms, rotations, n);
      if (usual != Mistake::none) return {usual};
    }
    if (!is_steady) return {Mistake::wrist_loose};
    has_start = true;
    start_palm = first_palm;
    start_mean = first_mean;
    const double turn = std::acos(cosine(palm, first_palm)), change = std::acos(kept);
    const bool has_our_axes = cosine(wrist_conventions()[0], now.mean) > kFarthestAxes;
    is_proven = was_proven || (has_our_axes && turn > kTurned && change < kKeptShare * turn);
    return {};
  }
};

}  // namespace handmap
