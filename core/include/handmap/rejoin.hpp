// How a robot comes back to the human after a hold, without a snap; see stream/rejoin.py.
#pragma once

#include "smoothing.hpp"

namespace handmap {

// Largest speeds that fading adds to a point in wrist axes [m/s], and to the wrist [m/s, rad/s].
constexpr double kFadingFinger = 0.4, kFadingPalm = 0.5, kFadingTurn = 3.0;
// Shortest time of fading [s].
constexpr double kShortestFading = 0.05;
// Largest speed of a minimum-jerk motion over its mean speed.
constexpr double kMinimumJerkPeak = 1.875;

// Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985).
inline double minimum_jerk(double share) {
  share = std::min(std::max(share, 0.0), 1.0);
  return share * share * share * (10.0 + share * (6.0 * share - 15.0));
}

// What is added to samples while a robot comes back: in wrist axes, from what the tracker said at the
// return to what was seen last. The palm's translation and turn are the last two.
using Offset = std::vector<Vec3>;

// Write the offset from the pose at a return to the one that was seen last.
inline void find_offset(const HumanPose& pose, const HumanPose& seen, Offset& to) {
  const size_t count = pose.points.size();
  const Pose here = pose.origin(), there = seen.origin();
  to.resize(count + 2);
  for (size_t i = 0; i < count; ++i) to[i] = seen.in_wrist(i) - pose.in_wrist(i);
  to[count] = there.p - here.p;
  to[count + 1] = log3(transposed(here.R) * there.R);
}

// Time in which an offset fades after a loss of the hand [s].
inline double fading_time(const Offset& offset, bool palm_fades, double lost) {
  const size_t palm = offset.size() - 2, turn = offset.size() - 1;
  double fingers = 0.0;
  for (size_t i = 0; i < palm; ++i) fingers = std::max(fingers, norm(offset[i]));
  double longest = fingers / kFadingFinger;
  if (palm_fades)
    longest = std::max({longest, norm(offset[palm]) / kFadingPalm, norm(offset[turn]) / kFadingTurn});
  return std::max(kShortestFading, std::min(lost, kMinimumJerkPeak * longest));
}

// Move a pose by the part of an offset that is left; the palm's part stays whole where it does not fade.
inline void add_offset(const Offset& offset, double left, bool palm_fades, HumanPose& pose) {
  const size_t palm = offset.size() - 2, turn = offset.size() - 1;
  const double palm_left = palm_fades ? left : 1.0;
  const Pose moved{pose.wrist.R * exp3(palm_left * offset[turn]),
                   pose.wrist.p + palm_left * offset[palm]};
  for (size_t i = 0; i < palm; ++i) {
    const Vec3 point = pose.in_wrist(i) + left * offset[i];
    pose.points[i] = pose.has_wrist ? moved * point : point;
  }
  if (pose.has_wrist) pose.wrist = moved;
}

// State of the return after a sample.
struct Rejoin {
  // Whether the robot glides back with its palm, too; else that stays where it is, as after a clutch.
  bool palm_fades = true;
  bool has_seen = false, has_offset = false;  // whether `seen` and `offset` are there
  HumanPose seen{};                           // the last pose that was mapped
  Offset offset{};
  double duration = 0.0;  // of fading [s]
  double elapsed = 0.0;   // since the return [s]

  // Whether the robot is still on its way to the human.
  bool is_fading() const { return has_offset && elapsed < duration; }

  // Begin at the first sample after a hold. After a brief loss [s], fading takes no longer than that, and
  // one that has begun goes on.
  void start(const HumanPose& pose, double lost) {
    if (is_fading() && lost < HUGE_VAL) return;
    has_offset = has_seen && seen.has_wrist == pose.has_wrist;
    if (!has_offset) return;
    find_offset(pose, seen, offset);
    duration = fading_time(offset, palm_fades, lost);
    elapsed = 0.0;
  }

  // Make the tracker's pose, `dt` after the one before [s], the one to map.
  void advance(HumanPose& pose, double dt) {
    if (!has_offset) return;
    const double left = 1.0 - minimum_jerk(elapsed / duration);
    elapsed += dt;
    has_offset = left > 0.0 || !palm_fades;
    add_offset(offset, left, palm_fades, pose);
  }
  // Make room for poses of so many points.
  void reserve(size_t points) {
    seen.points.reserve(points);
    offset.reserve(points + 2);
  }
  // Forget what was seen.
  void restart() {
    has_seen = has_offset = false;
    duration = elapsed = 0.0;
  }
};

}  // namespace handmap
