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

// What is added to samples while a robot comes back: `Place::to`, from what the tracker said at the
// return to what was seen last. The palm's translation and turn are the last two.
using Offset = std::vector<Vec3>;

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

// A pose with the part of an offset that is left; the palm's part stays whole where it does not fade.
inline HumanPose with_offset(const HumanPose& pose, const Offset& offset, double left, bool palm_fades) {
  Offset now = offset;
  for (size_t i = 0; i < now.size(); ++i)
    if (palm_fades || i + 2 < now.size()) now[i] = left * now[i];
  return Place::of(pose).moved(now).pose();
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
    offset = Place::of(pose).to(Place::of(seen));
    duration = fading_time(offset, palm_fades, lost);
    elapsed = 0.0;
  }

  // The pose to map for that of the tracker, `dt` after the one before [s].
  HumanPose advance(HumanPose&& pose, double dt) {
    if (!has_offset) return std::move(pose);
    const double left = 1.0 - minimum_jerk(elapsed / duration);
    elapsed += dt;
    has_offset = left > 0.0 || !palm_fades;
    return with_offset(pose, offset, left, palm_fades);
  }
};

}  // namespace handmap
