// A hand that follows a person's as a model: all that a `Follower` is made of; see models/follower.py,
// which says what its fields are.
#pragma once

#include "hand_model.hpp"
#include "ik_models.hpp"
#include "method_models.hpp"
#include "order.hpp"
#include "pair_models.hpp"
#include "person_models.hpp"

namespace handmap {

// How a robot's palm follows the human's, whatever the reference; `palm_at` makes the `PalmModel` of one.
struct PalmFollowingModel {
  static constexpr const char* kName = "PalmFollowingModel";
  bool aligns_palms = false;
  Mat3 alignment;
  double scale = 1.0;
  Pose human_wrist_to_palm, robot_wrist_to_palm;
  bool is_still = false;
  Vec3 human_anchor, robot_anchor;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("aligns_palms", aligns_palms);
    visit("alignment", alignment);
    visit("scale", scale);
    visit("human_wrist_to_palm", human_wrist_to_palm);
    visit("robot_wrist_to_palm", robot_wrist_to_palm);
    visit("is_still", is_still);
    visit("human_anchor", human_anchor);
    visit("robot_anchor", robot_anchor);
  }
  void check() const {}
};

struct FollowerModel {
  static constexpr const char* kName = "FollowerModel";
  std::string name;
  std::vector<std::string> joint_names, human_joint_names;
  double dt = 0.0, joint_tolerance = 0.0;
  HandModel human, robot;
  BoxLimits limits;
  IkModel ik;
  std::optional<PairsModel> pairs;
  std::optional<CollisionModel> collisions;
  GuardModel guard;
  std::vector<std::string> order_names;
  std::vector<Indices> orders;
  LandmarkReaderModel landmarks;
  PalmFollowingModel palm;
  TeleoperationModel teleoperation;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("name", name);
    visit("joint_names", joint_names);
    visit("human_joint_names", human_joint_names);
    visit("dt", dt);
    visit("joint_tolerance", joint_tolerance);
    visit("human", human);
    visit("robot", robot);
    visit("limits", limits);
    visit("ik", ik);
    visit("pairs", pairs);
    visit("collisions", collisions);
    visit("guard", guard);
    visit("order_names", order_names);
    visit("orders", orders);
    visit("landmarks", landmarks);
    visit("palm", palm);
    visit("teleoperation", teleoperation);
  }

  void check() const {
    human.check();
    robot.check();
    limits.check();
    if (pairs) pairs->check();
    if (collisions) collisions->check();
    guard.check();
    landmarks.check();
    teleoperation.check();
    expect_that(dt > 0.0 && dt < HUGE_VAL, "FollowerModel.dt", "a time above 0");
    expect_that(pairs.has_value() == collisions.has_value(), "FollowerModel.collisions",
                "how the pairs are kept apart");
    expect_count("FollowerModel.joint_names", joint_names.size(), robot.q_indices.size());
    expect_count("FollowerModel.human_joint_names", human_joint_names.size(),
                 human.q_indices.size());
    expect_that(joint_tolerance >= 0.0, "FollowerModel.joint_tolerance", "an angle of 0 or more");
    expect_count("FollowerModel.order_names", order_names.size(), orders.size());
    expect_that(!orders.empty(), "FollowerModel.orders", "one at least");
    for (const Indices& each : orders) {
      expect_count("FollowerModel.orders", each.size(), kLandmarks);
      expect_below("FollowerModel.orders", each, kLandmarks);
    }
    expect_count("FollowerModel.teleoperation: points of the human", landmarks.used.size(),
                 static_cast<size_t>(teleoperation.human_points));
    expect_count("FollowerModel.teleoperation: points of the robot", teleoperation.partners.size(),
                 robot.point_joints.size());
    expect_count("FollowerModel.teleoperation.rest", teleoperation.rest.size(),
                 robot.q_indices.size());
  }
};

}  // namespace handmap
