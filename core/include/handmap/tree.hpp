// Kinematics of a hand: a tree of joints with one axis each, on a wrist that may float.
#pragma once

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "lie.hpp"

namespace handmap {

using Vector = std::vector<double>;

enum class JointKind { revolute, prismatic, floating };

struct Joint {
  int parent;       // -1 for the world
  JointKind kind;
  Vec3 axis;
  Pose placement;   // in the parent's frame
  int q, v;         // first index in configurations and in the tangent space
};

// A point that is fixed to a joint; joint -1 is the world.
struct Attached {
  int joint;
  Vec3 offset;
};

// The turn about a unit axis.
inline Mat3 turned(const Vec3& a, double angle) {
  const double s = std::sin(angle), c = std::cos(angle), r = 1.0 - c;
  return {{c + r * a.x * a.x, r * a.x * a.y - s * a.z, r * a.x * a.z + s * a.y,
           r * a.x * a.y + s * a.z, c + r * a.y * a.y, r * a.y * a.z - s * a.x,
           r * a.x * a.z - s * a.y, r * a.y * a.z + s * a.x, c + r * a.z * a.z}};
}

// A frame of the URDF: of a joint, of a fixed one, or of a link.
struct Frame {
  enum Kind { joint_frame, fixed_joint, link, other };
  std::string name;
  Kind kind;
  int joint, parent;        // the joint that carries it, and the frame before it
  Pose placement;           // on the joint
};

// One hand of a robot: its wrist, in the frame of a joint, and the range of its reference points.
struct Part {
  int joint;
  Pose wrist;
  size_t first, end;
};

// What moves the world.
inline const std::vector<int> kNoCoordinates;

// What never changes of a hand.
struct Tree {
  int nq = 0, nv = 0, size = 0;  // size: number of active coordinates
  std::vector<Joint> joints;     // parents come first
  // Every coordinate of the tangent space is `factor` times its active coordinate `leader`.
  std::vector<int> leader;
  Vector factor;
  std::vector<std::vector<int>> supports;  // by joint: coordinates that move it
  std::vector<std::vector<int>> moving;    // by joint: active coordinates that move it, increasing
  bool is_floating = false;
  Attached wrist_origin{-1, {}};
  Pose wrist;                       // in the frame of its joint
  Attached palm_origin{-1, {}};
  Pose palm;                        // likewise
  std::vector<Attached> points;     // reference points
  std::vector<Part> parts;          // the hands; see hands.Hand.hands
  std::vector<int> point_frames;    // of the link of each of them
  std::vector<Vector> fingers;      // of each hand, 1 for each joint of its fingers
  std::vector<Frame> frames;
  Vector rest;                      // configuration at rest, with the wrist at the origin
  std::vector<int> set_by_joints;   // coordinates that joint positions set, and how: see `set_joints`
  Vector matrix, offset;
  std::vector<int> q_indices;       // of the joints, in the user's order
  std::vector<int> joint_columns;   // of the same in the active coordinates
  Vector joint_rest, lower, upper;  // their positions at rest, and their limits
  Vector joint_weights;             // what the motion of each costs, 1 for a finger's

  void finish() {
    supports.resize(joints.size());
    for (size_t j = 0; j < joints.size(); ++j) {
      if (joints[j].parent >= 0) supports[j] = supports[joints[j].parent];
      const int count = joints[j].kind == JointKind::floating ? 6 : 1;
      for (int c = 0; c < count; ++c) supports[j].push_back(joints[j].v + c);
      is_floating |= joints[j].kind == JointKind::floating;
    }
    for (const std::vector<int>& support : supports) {
      std::vector<int> active;
      for (const int c : support)
        if (factor[c] != 0.0) active.push_back(leader[c]);
      std::sort(active.begin(), active.end());
      active.erase(std::unique(active.begin(), active.end()), active.end());
      moving.push_back(active);
    }
  }

  // The configuration of joint positions, with the wrist at the origin.
  Vector configuration(const double* q) const {
    Vector found = rest;
    set_joints(q, found);
    return found;
  }
  void set_joints(const double* q, Vector& configuration) const {
    const size_t n = q_indices.size();
    for (size_t i = 0; i < set_by_joints.size(); ++i) {
      double sum = 0.0;
      for (size_t j = 0; j < n; ++j) sum += matrix[i * n + j] * q[j];
      configuration[set_by_joints[i]] = sum + offset[i];
    }
  }

  // Coordinates that move a joint, and the active ones among them; -1 is the world.
  const std::vector<int>& support_of(int joint) const {
    return joint < 0 ? kNoCoordinates : supports[joint];
  }
  const std::vector<int>& moving_of(int joint) const {
    return joint < 0 ? kNoCoordinates : moving[joint];
  }

  // Whether it has a joint of a number; -1 is the world.
  bool has_joint(int joint) const { return joint >= -1 && joint < static_cast<int>(joints.size()); }

  size_t find_frame(const std::string& name, Frame::Kind kind) const {
    for (size_t i = 0; i < frames.size(); ++i)
      if (frames[i].kind == kind && frames[i].name == name) return i;
    return frames.size();
  }

  // Place a joint elsewhere on its parent link, turned about its x axis; see hands.human.joint_moves.
  void move_joint(const std::string& name, const Vec3& origin, double roll) {
    size_t i = find_frame(name, Frame::joint_frame);
    const bool is_movable = i < frames.size();
    if (!is_movable) i = find_frame(name, Frame::fixed_joint);
    if (i == frames.size()) throw std::invalid_argument("no joint " + name);
    const Vec3 place = frames[frames[i].parent].placement * origin;
    if (is_movable) {
      Pose& placement = joints[frames[i].joint].placement;
      placement.p = place;
      placement.R = placement.R * turned({1.0, 0.0, 0.0}, roll);
      return;
    }
    const Vec3 shift = place - frames[i].placement.p;
    std::vector<char> is_moved(frames.size(), 0);
    is_moved[i] = 1;
    for (; i < frames.size(); ++i) {
      is_moved[i] |= is_moved[frames[i].parent];
      if (is_moved[i]) frames[i].placement.p += shift;
    }
    for (size_t k = 0; k < points.size(); ++k)
      if (is_moved[point_frames[k]]) points[k].offset += shift;
  }

  // A point of a link.
  Attached attached(const std::string& link, const Vec3& xyz) const {
    const size_t i = find_frame(link, Frame::link);
    if (i == frames.size()) throw std::invalid_argument("no link " + link);
    return {frames[i].joint, frames[i].placement * xyz};
  }

  // The tangent vector of all coordinates, of that of the active ones.
  void expand(const double* active, double* all) const {
    for (int c = 0; c < nv; ++c) all[c] = factor[c] * active[leader[c]];
  }

  // Go from a configuration along a tangent vector of all coordinates.
  void integrate(const double* q, const double* step, double* reached) const {
    for (const Joint& joint : joints) {
      if (joint.kind != JointKind::floating) {
        reached[joint.q] = q[joint.q] + step[joint.v];
        continue;
      }
      const double *a = q + joint.q, *s = step + joint.v;
      const Quat turn{a[3], a[4], a[5], a[6]};
      const Twist twist{{s[0], s[1], s[2]}, {s[3], s[4], s[5]}};
      const Vec3 moved = rotation_of(turn) * exp6_translation(twist);
      Quat r = turn * quat_exp(twist.w);
      // The sign nearest to the quaternion before, and one step towards length 1.
      const double sign = r.x * a[3] + r.y * a[4] + r.z * a[5] + r.w * a[6] < 0.0 ? -1.0 : 1.0;
      const double length2 = r.x * r.x + r.y * r.y + r.z * r.z + r.w * r.w;
      const double scale = sign * 0.5 * (3.0 - length2);
      double* to = reached + joint.q;
      to[0] = a[0] + moved.x;
      to[1] = a[1] + moved.y;
      to[2] = a[2] + moved.z;
      to[3] = scale * r.x;
      to[4] = scale * r.y;
      to[5] = scale * r.z;
      to[6] = scale * r.w;
    }
  }
};

// A hand in one posture.
class Placed {
 public:
  explicit Placed(const Tree& tree)
      : tree_(tree), q(tree.nq), poses_(tree.joints.size() + 1), columns(tree.nv) {}

  void place(const double* configuration) {
    if (has_placed_ && std::equal(q.begin(), q.end(), configuration)) return;
    std::copy(configuration, configuration + tree_.nq, q.begin());
    has_placed_ = true;
    for (size_t j = 0; j < tree_.joints.size(); ++j) {
      const Joint& joint = tree_.joints[j];
      const Pose at = joint.parent < 0 ? joint.placement : pose(joint.parent) * joint.placement;
      Pose& pose = poses_[j + 1];
      const double* x = q.data() + joint.q;
      switch (joint.kind) {
        case JointKind::revolute: {
          pose.R = at.R * turned(joint.axis, x[0]);
          pose.p = at.p;
          const Vec3 w = at.R * joint.axis;
          columns[joint.v] = {cross(pose.p, w), w};
          break;
        }
        case JointKind::prismatic: {
          const Vec3 along = at.R * joint.axis;
          pose.R = at.R;
          pose.p = at.p + x[0] * along;
          columns[joint.v] = {along, {}};
          break;
        }
        case JointKind::floating: {
          pose = at * Pose{rotation_of({x[3], x[4], x[5], x[6]}), {x[0], x[1], x[2]}};
          for (int i = 0; i < 3; ++i) {
            const Vec3 axis = pose.R.column(i);
            columns[joint.v + i] = {axis, {}};
            columns[joint.v + 3 + i] = {cross(pose.p, axis), axis};
          }
        }
      }
    }
  }

  // Go to the posture of another one of the same tree.
  void copy(const Placed& other) {
    q = other.q;
    poses_ = other.poses_;
    columns = other.columns;
    has_placed_ = other.has_placed_;
  }

  // Go from a configuration by a displacement of the active coordinates, to where another one may be.
  void displace(const double* start, const double* displacement, const Placed* other = nullptr) {
    step_.resize(tree_.nv);
    reached_.resize(tree_.nq);
    tree_.expand(displacement, step_.data());
    tree_.integrate(start, step_.data(), reached_.data());
    if (other && other->has_placed_ && other->q == reached_) return copy(*other);
    place(reached_.data());
  }

  const Pose& pose(int joint) const { return poses_[joint + 1]; }
  Vec3 point(const Attached& at) const { return pose(at.joint) * at.offset; }
  Pose wrist() const { return pose(tree_.wrist_origin.joint) * tree_.wrist; }
  Pose wrist(const Part& part) const { return pose(part.joint) * part.wrist; }
  // Velocity of a point of space that moves with the tree, per velocity of a coordinate.
  Vec3 velocity(int column, const Vec3& point) const {
    return columns[column].v + cross(columns[column].w, point);
  }
  const Tree& tree() const { return tree_; }

 private:
  const Tree& tree_;

 public:
  Vector q;

 private:
  std::vector<Pose> poses_;  // that of the world first
  Vector step_, reached_;
  bool has_placed_ = false;

 public:
  // Spatial velocity at the world's origin per velocity of each coordinate.
  std::vector<Twist> columns;
};

}  // namespace handmap
