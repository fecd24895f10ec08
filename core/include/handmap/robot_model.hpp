// The hands of a robot as a model; see models/robot.py, which says what its fields are.
#pragma once

#include <algorithm>

#include "model_reader.hpp"

namespace handmap {

// A hand of a robot.
struct RobotHandModel {
  static constexpr const char* kName = "RobotHandModel";
  int palm_joint = 0;
  Pose palm;
  Indices pinching, among_own;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("palm_joint", palm_joint);
    visit("palm", palm);
    visit("pinching", pinching);
    visit("among_own", among_own);
  }
};

// The hands of a robot, and how their palms are led; see `RobotMapper`.
struct RobotModel {
  static constexpr const char* kName = "RobotModel";
  std::vector<RobotHandModel> hands;
  double turns_in = 0.0, near = 0.0, together = 0.0, together_share = 0.0, margin = 0.0;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("hands", hands);
    visit("turns_in", turns_in);
    visit("near", near);
    visit("together", together);
    visit("together_share", together_share);
    visit("margin", margin);
  }

  void check() const {
    expect_that(!hands.empty(), "RobotModel.hands", "a hand at least");
    for (const RobotHandModel& hand : hands)
      expect_count("RobotModel.hands: among_own", hand.among_own.size(), hand.pinching.size());
  }

  bool has_pinches() const {
    return std::any_of(hands.begin(), hands.end(),
                       [](const RobotHandModel& hand) { return !hand.pinching.empty(); });
  }
};

}  // namespace handmap
