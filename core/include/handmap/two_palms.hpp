// How the palms of a robot turn to the person's, and come together as theirs do.
#pragma once

#include <algorithm>
#include <optional>

#include "robot_model.hpp"
#include "targets.hpp"

namespace handmap {

// A palm of a robot that a person's leads.
struct LedPalm {
  const PalmMap* map = nullptr;
  Pose person;  // the person's palm in the robot's world

  // Where its anchor is for a target of the wrist.
  Vec3 anchor(const Pose& wrist) const { return palm(wrist) * map->robot_anchor; }

  // The motion that turns the target of a wrist about the anchor, by a share of what is left to the
  // person's axes, and then shifts it.
  Pose turn(const Pose& wrist, double share, const Vec3& shift = {}) const {
    const Vec3 centre = anchor(wrist);
    const Mat3 turn = exp3(share * log3(person.R * transposed(palm(wrist).R)));
    return {turn, centre - turn * centre + shift};
  }

 private:
  Pose palm(const Pose& wrist) const { return wrist * inverse(map->robot_palm_to_wrist); }
};

// How near palms go by the person's.
struct Meeting {
  Pose motions[2];  // of the targets of both hands
  Vec3 aim;         // offset of the other anchor from the first one [m]
  double share;     // of the weight of that offset, from 0 to 1
};

// Near palms are seen from each other as the person's are. None for palms that are not near, or that
// do not go by one alignment. `wrists` are the targets of both.
inline std::optional<Meeting> meeting_of(const LedPalm (&palms)[2], const Pose (&wrists)[2],
                                         double near, double together) {
  const PalmMap &first = *palms[0].map, &other = *palms[1].map;
  const Vec3 apart = palms[1].person.p - palms[0].person.p;
  const double gap = norm(apart) / (1.0 + first.further);
  const double share = smoothstep((near - gap) / (near - together));
  if (share == 0.0 || !std::equal(first.alignment.m, first.alignment.m + 9, other.alignment.m))
    return {};
  const Vec3 offset = palms[1].anchor(wrists[1]) - palms[0].anchor(wrists[0]);
  const Vec3 aim = offset + share * (apart - offset);
  const Vec3 half = 0.5 * (aim - offset);
  return Meeting{{palms[0].turn(wrists[0], share, -half), palms[1].turn(wrists[1], share, half)},
                 aim,
                 share};
}

}  // namespace handmap
