// A hand as a model; see models/hand.py, which says what its fields are. `tree_of` makes its `Tree`.
#pragma once

#include <algorithm>
#include <cmath>

#include "model_reader.hpp"

namespace handmap {

// Squares of larger weights drown all other costs in rounding.
constexpr double kMostJointWeight = 1e4;

struct JointModel {
  static constexpr const char* kName = "JointModel";
  std::string kind;
  int parent = -1;
  Vec3 axis;
  Pose placement;
  int q = 0, v = 0;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("kind", kind);
    visit("parent", parent);
    visit("axis", axis);
    visit("placement", placement);
    visit("q", q);
    visit("v", v);
  }
};

struct FrameModel {
  static constexpr const char* kName = "FrameModel";
  std::string name, kind;
  int joint = -1, parent = 0;
  Pose placement;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("name", name);
    visit("kind", kind);
    visit("joint", joint);
    visit("parent", parent);
    visit("placement", placement);
  }
};

struct PlaceModel {
  static constexpr const char* kName = "PlaceModel";
  int joint = -1;
  Pose placement;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("joint", joint);
    visit("placement", placement);
  }
};

struct HandModel {
  static constexpr const char* kName = "HandModel";
  int nq = 0, nv = 0;
  std::vector<JointModel> joints;
  std::vector<FrameModel> frames;
  Matrix spread;
  Indices q_indices, joint_columns;
  Vector configuration;
  Indices moving_q;
  Matrix motion;
  Vector shift, rest, lower, upper, joint_weights;
  std::vector<PlaceModel> wrists;
  PlaceModel palm;
  Indices point_counts, point_joints;
  std::vector<Vec3> point_offsets;
  Indices point_frames;
  Matrix fingers;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("nq", nq);
    visit("nv", nv);
    visit("joints", joints);
    visit("frames", frames);
    visit("spread", spread);
    visit("q_indices", q_indices);
    visit("joint_columns", joint_columns);
    visit("configuration", configuration);
    visit("moving_q", moving_q);
    visit("motion", motion);
    visit("shift", shift);
    visit("rest", rest);
    visit("lower", lower);
    visit("upper", upper);
    visit("joint_weights", joint_weights);
    visit("wrists", wrists);
    visit("palm", palm);
    visit("point_counts", point_counts);
    visit("point_joints", point_joints);
    visit("point_offsets", point_offsets);
    visit("point_frames", point_frames);
    visit("fingers", fingers);
  }

  void check() const {
    const size_t joint_count = joints.size(), n = q_indices.size(), points = point_joints.size();
    expect_that(nq >= 0 && static_cast<size_t>(nq) <= 7 * joint_count && nv >= 0 &&
                    static_cast<size_t>(nv) <= 6 * joint_count,
                "HandModel.nq and nv", "the coordinates of its joints");
    for (size_t j = 0; j < joint_count; ++j) check_joint(j);
    for (size_t i = 0; i < frames.size(); ++i) {
      const std::string path = "HandModel.frames[" + std::to_string(i) + "]";
      const std::string& kind = frames[i].kind;
      const bool is_joint = kind == "joint";
      expect_that(is_joint || kind == "fixed_joint" || kind == "link" || kind == "other", path + ".kind",
                  "joint, fixed_joint, link or other");
      expect_below(path + ".joint", {frames[i].joint}, joint_count, -1);
      expect_that(!is_joint || frames[i].joint >= 0, path + ".joint", "the joint that it is of");
      // The world's frame is its own parent.
      expect_below(path + ".parent", {frames[i].parent}, i + 1);
    }
    expect_count("HandModel.spread", spread.rows, static_cast<size_t>(nv));
    expect_that(spread.columns > 0, "HandModel.spread", "a column at least");
    expect_below("HandModel.q_indices", q_indices, static_cast<size_t>(nq));
    expect_count("HandModel.joint_columns", joint_columns.size(), n);
    expect_below("HandModel.joint_columns", joint_columns, spread.columns);
    expect_count("HandModel.configuration", configuration.size(), static_cast<size_t>(nq));
    expect_below("HandModel.moving_q", moving_q, static_cast<size_t>(nq));
    expect_count("HandModel.motion", motion.rows, shift.size());
    expect_that(motion.rows >= moving_q.size() && motion.columns == n, "HandModel.motion",
                "a row for each coordinate of moving_q, a column for each joint");
    expect_count("HandModel.rest", rest.size(), n);
    expect_count("HandModel.lower", lower.size(), n);
    expect_count("HandModel.upper", upper.size(), n);
    for (size_t j = 0; j < n; ++j)
      expect_that(lower[j] <= upper[j], "HandModel.lower", "limits that are not above the upper ones");
    expect_count("HandModel.joint_weights", joint_weights.size(), n);
    for (const double weight : joint_weights)
      expect_that(weight > 0.0 && weight <= kMostJointWeight, "HandModel.joint_weights",
                  "numbers above 0, and not above 10000");
    expect_that(!wrists.empty(), "HandModel.wrists", "one at least");
    for (const PlaceModel& wrist : wrists)
      expect_below("HandModel.wrists: joint", {wrist.joint}, joint_count, -1);
    expect_below("HandModel.palm.joint", {palm.joint}, joint_count, -1);
    expect_count("HandModel.point_counts", point_counts.size(), wrists.size());
    size_t total = 0;
    for (const int count : point_counts) {
      expect_below("HandModel.point_counts", {count}, points + 1);
      total += static_cast<size_t>(count);
    }
    expect_count("HandModel.point_joints", points, total);
    expect_below("HandModel.point_joints", point_joints, joint_count, -1);
    expect_count("HandModel.point_offsets", point_offsets.size(), points);
    expect_count("HandModel.point_frames", point_frames.size(), points);
    expect_below("HandModel.point_frames", point_frames, frames.size());
    expect_count("HandModel.fingers", fingers.rows, wrists.size());
    expect_that(fingers.columns == n, "HandModel.fingers", "a column for each joint");
  }

 private:
  void check_joint(size_t j) const {
    const JointModel& joint = joints[j];
    const std::string path = "HandModel.joints[" + std::to_string(j) + "]";
    const bool is_floating = joint.kind == "floating";
    expect_that(is_floating || joint.kind == "revolute" || joint.kind == "prismatic", path + ".kind",
                "revolute, prismatic or floating");
    // Behind its parent, and with its numbers in configurations.
    expect_below(path + ".parent", {joint.parent}, j, -1);
    expect_that(joint.q >= 0 && joint.q <= nq - (is_floating ? 7 : 1) && joint.v >= 0 &&
                    joint.v <= nv - (is_floating ? 6 : 1),
                path + ".q and v", "indices of its coordinates");
  }
};

inline Tree tree_of(HandModel model) {
  Tree tree;
  tree.nq = model.nq;
  tree.nv = model.nv;
  for (const JointModel& joint : model.joints) {
    const JointKind kind = joint.kind == "revolute"    ? JointKind::revolute
                           : joint.kind == "prismatic" ? JointKind::prismatic
                                                       : JointKind::floating;
    tree.joints.push_back({joint.parent, kind, joint.axis, joint.placement, joint.q, joint.v});
  }
  for (FrameModel& frame : model.frames) {
    const Frame::Kind kind = frame.kind == "joint"         ? Frame::joint_frame
                             : frame.kind == "fixed_joint" ? Frame::fixed_joint
                             : frame.kind == "link"        ? Frame::link
                                                           : Frame::other;
    tree.frames.push_back(
        {std::move(frame.name), kind, frame.joint, frame.parent, frame.placement});
  }
  tree.size = static_cast<int>(model.spread.columns);
  for (size_t c = 0; c < model.spread.rows; ++c) {
    const double* row = model.spread.row(c);
    const double* most = std::max_element(
        row, row + tree.size, [](double a, double b) { return std::abs(a) < std::abs(b); });
    tree.leader.push_back(static_cast<int>(most - row));
    tree.factor.push_back(*most);
  }
  tree.q_indices = std::move(model.q_indices);
  tree.joint_columns = std::move(model.joint_columns);
  tree.rest = std::move(model.configuration);
  tree.set_by_joints = std::move(model.moving_q);
  tree.matrix = std::move(model.motion.data);
  tree.offset = std::move(model.shift);
  tree.joint_rest = std::move(model.rest);
  tree.lower = std::move(model.lower);
  tree.upper = std::move(model.upper);
  tree.joint_weights = std::move(model.joint_weights);
  for (size_t k = 0; k < model.point_joints.size(); ++k)
    tree.points.push_back({model.point_joints[k], model.point_offsets[k]});
  tree.point_frames = std::move(model.point_frames);
  for (size_t i = 0; i < model.wrists.size(); ++i) {
    const PlaceModel& wrist = model.wrists[i];
    const size_t first = tree.parts.empty() ? 0 : tree.parts.back().end;
    const size_t end = first + static_cast<size_t>(model.point_counts[i]);
    tree.parts.push_back({wrist.joint, wrist.placement, first, end});
    const double* row = model.fingers.row(i);
    tree.fingers.emplace_back(row, row + model.fingers.columns);
  }
  tree.wrist_origin = {tree.parts[0].joint, {}};
  tree.wrist = tree.parts[0].wrist;
  tree.palm_origin = {model.palm.joint, {}};
  tree.palm = model.palm.placement;
  tree.finish();
  return tree;
}

}  // namespace handmap
