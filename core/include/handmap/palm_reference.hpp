// The reference of palms that follow each other: both hands at the instant that motion is counted from.
#pragma once

#include "follower_model.hpp"

namespace handmap {

// How the robot's palm follows from a reference on, at which both wrists are where they are.
//
// Both palms have the same rotation, and the same translation (or `scale` times it) in world axes, turned
// by the alignment; the translation is that of an anchor point on each palm. If anchors and axes coincide
// at the reference, they stay together.
inline PalmModel palm_at(const PalmFollowingModel& following, const Pose& human_wrist,
                         const Pose& robot_wrist) {
  const Pose before = human_wrist * following.human_wrist_to_palm;
  PalmModel palm;
  palm.human_wrist_to_palm = following.human_wrist_to_palm;
  palm.robot_palm_to_wrist = inverse(following.robot_wrist_to_palm);
  palm.is_still = following.is_still;
  palm.start = robot_wrist * following.robot_wrist_to_palm;
  palm.alignment =
      following.aligns_palms ? palm.start.R * transposed(before.R) : following.alignment;
  // The robot's palm in axes of the human's world.
  const Mat3 back = transposed(palm.alignment);
  const Pose start{back * palm.start.R, back * palm.start.p};
  palm.rotation = transposed(before.R) * start.R;
  palm.origin = following.human_anchor - palm.rotation * following.robot_anchor;
  palm.human_anchor = following.human_anchor;
  palm.robot_anchor = following.robot_anchor;
  palm.human_start = before * following.human_anchor;
  palm.offset = start * following.robot_anchor - palm.human_start;
  palm.further = following.scale - 1.0;
  return palm;
}

// Where the palm of a robot without a place is put at a reference: on the human's, as the alignment takes
// it to the robot's world, so that the anchors of both hands have one place; at the origin where palms
// are aligned.
inline Pose start_palm(const PalmFollowingModel& following, const Pose& human_wrist) {
  Pose palm;
  if (!following.aligns_palms) {
    const Pose human = human_wrist * following.human_wrist_to_palm;
    palm = {following.alignment * human.R, following.alignment * human.p};
  }
  palm.p += palm.R * (following.human_anchor - following.robot_anchor);
  return palm;
}

}  // namespace handmap
