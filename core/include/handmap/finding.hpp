// What can be wrong with a sample, and with input as such: kinds and numbers. Python has the words.
#pragma once

#include "order.hpp"

namespace handmap {

// What is wrong with a sample; a sample's row in a table of steps has the number.
enum Rule {
  kNothing, kMissing, kZero, kSize, kOutlier, kJump, kFlipped, kFrozen, kGapped, kSettling,
  kDuplicate, kDisorder, kClockJump, kTime, kUnit, kOrder, kSide, kFlexion, kWrist, kUnproven
};
constexpr const char* kRuleNames[] = {
    "",          "missing",  "zero",       "size", "outlier", "jump",  "flip", "frozen",  "gap",
    "settling",  "duplicate", "disorder",  "clock_jump", "time", "unit", "order", "side",
    "flexion",   "wrist",    "unproven"};

// What the input is instead of what it says.
enum class Mistake {
  none,
  rate,           // stamps run at `number` times the speed of arrival
  step,           // `number` is the usual time between samples [s]
  image,          // image coordinates: the wrist's z is always 0
  length,         // the hand is `number` long [m]
  order,          // landmarks are in the order `which`
  unknown_order,  // landmarks are no hand in any known order
  flexion,        // fingers bend backwards
  other_side,     // the other hand, or a mirrored world
  other_hand,     // the other hand, with its wrist
  mirrored,       // a mirrored hand, whose wrist is not
  stuck,          // the finger `which` repeats while others do not
  resized,        // the hand is `number` times as large as at first
  wrist_away,     // the wrist's pose is `number` from its landmark [m]
  wrist_wxyz,     // a quaternion w, x, y, z was read as x, y, z, w
  wrist_xyzw,     // the other way round
  wrist_inverse,  // the inverse pose
  wrist_loose,    // the wrist's orientation does not follow the palm
};

struct MistakeName {
  const char* name;
  Rule rule;
};
// In the order of `Mistake`.
constexpr MistakeName kMistakes[] = {
    {"", kNothing},         {"rate", kTime},           {"step", kTime},
    {"image", kUnit},       {"length", kUnit},         {"order", kOrder},
    {"unknown_order", kOrder}, {"flexion", kFlexion},  {"other_side", kSide},
    {"other_hand", kSide},  {"mirrored", kSide},       {"stuck", kFrozen},
    {"resized", kSize},     {"wrist_away", kWrist},    {"wrist_wxyz", kWrist},
    {"wrist_xyzw", kWrist}, {"wrist_inverse", kWrist}, {"wrist_loose", kWrist}};

struct Finding {
  Mistake mistake = Mistake::none;
  double number = kNaN;
  int which = -1;

  bool is_none() const { return mistake == Mistake::none; }
  bool is_sound() const {
    const auto last = Mistake::wrist_loose;
    const bool has_place = mistake != Mistake::order && mistake != Mistake::stuck;
    return Mistake::none <= mistake && mistake <= last && (has_place || which >= 0);
  }
  Rule rule() const { return kMistakes[static_cast<int>(mistake)].rule; }
};

}  // namespace handmap
