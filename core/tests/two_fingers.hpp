// What the programs that test the core without Python share: random numbers, and a small hand.
#pragma once

#include <memory>
#include <random>
#include <vector>

#include "handmap/pairs.hpp"

namespace handmap {

// Numbers that an honest sensor gives, and those that none does.
class Numbers {
 public:
  explicit Numbers(unsigned seed) : engine_(seed) {}

  int below(int count) { return std::uniform_int_distribution<int>(0, count - 1)(engine_); }
  double plain(double size = 1.0) { return std::normal_distribution<double>(0.0, size)(engine_); }
  double number(double hostile, double size = 1.0) {
    constexpr double kHostile[] = {0.0,    -0.0,   1e300,  -1e300, 1e-300, 1e160,
                                   -1e160, 1e9,    HUGE_VAL, -HUGE_VAL, NAN};
    const bool is_hostile = std::uniform_real_distribution<double>(0.0, 1.0)(engine_) < hostile;
    return is_hostile ? kHostile[below(11)] : plain(size);
  }
  Vec3 point(double hostile, double size = 1.0) {
    return {number(hostile, size), number(hostile, size), number(hostile, size)};
  }
  Vector vector(size_t count, double hostile, double size = 1.0) {
    Vector found(count);
    for (double& each : found) each = number(hostile, size);
    return found;
  }
  std::vector<Vec3> points(size_t count, double hostile, double size = 1.0) {
    std::vector<Vec3> found(count);
    for (Vec3& each : found) each = point(hostile, size);
    return found;
  }
  Pose pose(double hostile, double size = 0.1) {
    Pose found{exp3(point(0.0)), point(hostile, size)};
    if (hostile > 0.0 && below(4) == 0) found.R.m[below(9)] = number(hostile);
    return found;
  }

 private:
  std::mt19937 engine_;
};

// Two fingers of two joints on a palm that may float. About the x axis they bend side by side; about the
// z axis they move in one plane, and their tips can meet.
inline Tree fingers(bool is_floating, const Vec3& axis = {1, 0, 0}) {
  Tree tree;
  const int first = is_floating ? 1 : 0;
  if (is_floating) tree.joints.push_back({-1, JointKind::floating, {}, {}, 0, 0});
  tree.nq = is_floating ? 7 : 0;
  tree.nv = is_floating ? 6 : 0;
  for (int finger = 0; finger < 2; ++finger)
    for (int k = 0; k < 2; ++k) {
      const int parent = k ? static_cast<int>(tree.joints.size()) - 1 : first - 1;
      const Vec3 at = k ? Vec3{0.0, 0.04, 0.0} : Vec3{0.03 * finger, 0.05, 0.0};
      tree.joints.push_back({parent, JointKind::revolute, axis, {{}, at}, tree.nq++, tree.nv++});
      tree.q_indices.push_back(tree.nq - 1);
      tree.joint_columns.push_back(tree.nv - 1);
    }
  tree.size = tree.nv;
  for (int c = 0; c < tree.nv; ++c) {
    tree.leader.push_back(c);
    tree.factor.push_back(1.0);
  }
  tree.points = {{first + 1, {0, 0.03, 0}}, {first + 3, {0, 0.03, 0}}};
  tree.wrist_origin = tree.palm_origin = {first - 1, {}};
  tree.parts = {{first - 1, {}, 0, 2}};
  tree.rest.assign(tree.nq, 0.0);
  if (is_floating) tree.rest[6] = 1.0;
  tree.joint_rest.assign(4, 0.0);
  tree.lower.assign(4, -1.5);
  tree.upper.assign(4, 1.5);
  tree.fingers = {Vector(4, 1.0)};
  tree.finish();
  return tree;
}

// A shape on the last link of each finger, and what bounds the distance of both. No point of them is
// farther than 80 mm from a joint that moves it.
inline std::shared_ptr<PairBounds> pair_of(const Tree& tree, const Shape& shape, const Vec3& at,
                                           double radius) {
  auto bounds = std::make_shared<PairBounds>();
  const int first = tree.is_floating ? 1 : 0;
  for (const int joint : {first + 1, first + 3})
    bounds->bodies.push_back({joint, {{}, at}, shape, at, radius});
  Sparse levers, turns, signs;
  for (const int joint : {first, first + 1, first + 2, first + 3}) {
    const int c = tree.joints[joint].v;
    for (Sparse* each : {&levers, &turns, &signs}) each->columns.push_back(c);
    levers.values.push_back(0.08);
    turns.values.push_back(1.0);
    signs.values.push_back(joint < first + 2 ? 1.0 : -1.0);
  }
  bounds->pairs.push_back({0, 1, levers, turns, signs});
  bounds->finish();
  return bounds;
}

inline std::shared_ptr<PairBounds> boxes_of(const Tree& tree) {
  return pair_of(tree, make_box({0.01, 0.02, 0.01}), {}, 0.03);
}

// Position limits of 1.5 rad and speed limits of 3 rad/s for all coordinates.
inline BoxLimits box_limits_of(const Tree& tree) {
  BoxLimits limits;
  limits.lowest.assign(tree.nq, -kInfinity);
  limits.highest.assign(tree.nq, kInfinity);
  limits.lower.assign(tree.size, -1.5);
  limits.upper.assign(tree.size, 1.5);
  limits.speeds.assign(tree.size, 3.0);
  limits.together.assign(tree.size, 0);
  for (const Joint& joint : tree.joints) {
    const int count = joint.kind == JointKind::floating ? 6 : 1;
    for (int k = 0; k < count; ++k) limits.coordinates.push_back(joint.q + k);
  }
  return limits;
}

}  // namespace handmap
