// One sample, from what was measured on the human to the robot's command: see mapping/hand_mapper.py.
#pragma once

#include <optional>
#include <stdexcept>

#include "detours.hpp"
#include "targets.hpp"

namespace handmap {

// See se3.FARTHEST [m], se3._ROTATION_EXACT and se3._ROTATION_TOLERANCE.
constexpr double kFarthest = 1e9, kExactRotation = 1e-12, kRotationTolerance = 1e-3;

// Whether no number is farther than any hand; NaN is.
inline bool is_near(const double* numbers, size_t count) {
  for (size_t i = 0; i < count; ++i)
    if (!(std::abs(numbers[i]) <= kFarthest)) return false;
  return true;
}

// A pose that is near, whose rotation is off one by no more than a tolerance.
inline std::optional<Pose> pose_within(const double* m, double tolerance) {
  if (!is_near(m, 16) || m[12] != 0.0 || m[13] != 0.0 || m[14] != 0.0 || m[15] != 1.0) return {};
  const Pose pose{{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}}, {m[3], m[7], m[11]}};
  const Mat3 square = transposed(pose.R) * pose.R, eye;
  for (int i = 0; i < 9; ++i)
    if (!(std::abs(square.m[i] - eye.m[i]) <= tolerance)) return {};
  if (determinant(pose.R) < 0.0) return {};
  return pose;
}

// A pose, if its rotation is one up to rounding and it is near.
inline std::optional<Pose> exact_pose(const double* m) { return pose_within(m, kExactRotation); }

// A pose as trackers have them, in floats or as products of many: with the rotation nearest to it.
inline std::optional<Pose> tracked_pose(const double* m) {
  if (const std::optional<Pose> exact = exact_pose(m)) return exact;
  std::optional<Pose> pose = pose_within(m, kRotationTolerance);
  if (pose) pose->R = nearest_rotation(pose->R);
  return pose;
}

// See method.HumanPose.
struct HumanPose {
  std::vector<Vec3> points;
  bool has_wrist = false;
  Pose wrist;

  // The wrist, or the origin of the world where there is none.
  Pose origin() const { return has_wrist ? wrist : Pose{}; }
  // A point seen from there.
  Vec3 in_wrist(size_t i) const {
    return has_wrist ? tmul(wrist.R, points[i] - wrist.p) : points[i];
  }
};

// See readers.LandmarkReader.
class LandmarkReader {
 public:
  explicit LandmarkReader(LandmarkReaderModel model) : model_(std::move(model)) {}

  // Number of the points that it reads.
  size_t size() const { return model_.used.size(); }

  // Write a sample's pose. Without a wrist, it is fitted to the palm.
  void read(const double* landmarks, const Pose* wrist, HumanPose& to) const {
    to.points.resize(size());
    for (size_t k = 0; k < size(); ++k) to.points[k] = point(landmarks, model_.used[k]);
    to.has_wrist = true;
    to.wrist = wrist ? *wrist : fitted_wrist(landmarks);
  }
  HumanPose read(const double* landmarks, const Pose* wrist) const {
    HumanPose pose;
    read(landmarks, wrist, pose);
    return pose;
  }

 private:
  const LandmarkReaderModel model_;

  Pose fitted_wrist(const double* landmarks) const {
    Vec3 seen[std::size(kPalm)];
    for (size_t k = 0; k < std::size(kPalm); ++k) seen[k] = point(landmarks, kPalm[k]);
    return rigid_fit(model_.palm.data(), seen, model_.weights, nearest_rotation);
  }

  static Vec3 point(const double* landmarks, int i) {
    return {landmarks[3 * i], landmarks[3 * i + 1], landmarks[3 * i + 2]};
  }
};

// See readers.JointReader.
class JointReader {
 public:
  explicit JointReader(Tree given) : tree_(std::move(given)), at_(tree_), vector_(tree_.rest) {}
  JointReader(const JointReader&) = delete;

  // Number of the joints that it reads.
  size_t size() const { return tree_.q_indices.size(); }

  bool is_within_limits(const double* q) const {
    for (size_t j = 0; j < size(); ++j)
      if (!(q[j] >= tree_.lower[j] && q[j] <= tree_.upper[j])) return false;
    return true;
  }

  // How far a joint is outside its limits at an angle; NaN where that is none.
  double outside(size_t j, double q) const {
    return std::isnan(q) ? q : std::max({tree_.lower[j] - q, q - tree_.upper[j], 0.0});
  }

  // Write the pose of joint angles. Points move with the wrist, which the tree has at its origin.
  void read(const double* q, const Pose& wrist, HumanPose& to) {
    tree_.set_joints(q, vector_);
    at_.place(vector_.data());
    to.points.resize(tree_.points.size());
    for (size_t k = 0; k < to.points.size(); ++k) to.points[k] = wrist * at_.point(tree_.points[k]);
    to.has_wrist = true;
    to.wrist = wrist;
  }
  HumanPose read(const double* q, const Pose& wrist) {
    HumanPose pose;
    read(q, wrist, pose);
    return pose;
  }

 private:
  const Tree tree_;
  Placed at_;
  Vector vector_;
};

// All results of a sample.
struct Step {
  Targets targets;
  Result result;
  Motion motion;
  Vector q;  // in the user's order
};

inline void finish(const Ik& ik, Step& step) {
  step.motion = ik.motion;
  step.q.clear();
  for (const int i : ik.tree.q_indices) step.q.push_back(ik.motion.q[i]);
}

// The targets of a map, and the motion towards them; `goal` is a workspace.
inline void follow(Ik& ik, const TargetMap& map, const HumanPose& pose, const When& when,
                   double speed, Goal& goal, Step& step) {
  Targets& targets = step.targets;
  map.targets(pose.points, pose.has_wrist ? &pose.wrist : nullptr, targets);
  if (targets.points.size() != ik.tree.points.size() ||
      (!targets.margins.empty() && (!ik.pairs || targets.margins.size() != ik.pairs->size())))
    throw std::invalid_argument("the map is of another hand");
  goal.points = targets.points;
  goal.wrists = {targets.wrist};
  ik.set_postures(targets.rest, ik.motion.next(when).granted, goal.postures);
  if (targets.regularisation)
    goal.regularise(*targets.regularisation);
  else
    goal.damping_shares.clear();
  goal.distances.clear();
  if (targets.distances)
    goal.distances.add().set(*targets.distances, targets.aims, targets.weights);
  seek(ik, goal, when, targets.margins, speed, step.result);
  targets.points = step.result.targets;
  finish(ik, step);
}

// Take the stop that was admitted last, for one sample.
inline void hold(Ik& ik, const When& when, Step& step) {
  ik.hold(when, step.result);
  step.targets.points = step.result.points;
  step.targets.wrist = step.result.wrists[0];
  finish(ik, step);
}

}  // namespace handmap
