// Pairs of shapes that are kept apart: see handmap_qp/ik/collision.py, whose names these are.
#pragma once

#include <limits>
#include <memory>
#include <vector>

#include "limits.hpp"
#include "shapes.hpp"
#include "tree.hpp"

namespace handmap {

constexpr double kKept = 2e-4;
constexpr int kMostPoints = 30;
constexpr double kGain = 0.85;
constexpr double kNear = 0.001, kApproach = 0.5;
constexpr double kExpected = 0.25;

// One number for some coordinates of the tangent space.
struct Sparse {
  std::vector<int> columns;
  Vector values;
  double dot(const double* x) const {
    double sum = 0.0;
    for (size_t k = 0; k < columns.size(); ++k) sum += values[k] * x[columns[k]];
    return sum;
  }
};

struct Body {
  int joint;
  Pose placement;
  Shape shape;
  Vec3 centre;  // of its bounding ball, in the joint's frame
  double radius;
};

struct Pair {
  int first, second;
  Sparse levers, turns;
  Sparse signs;  // 1 where a coordinate moves the first shape, -1 where it moves the second
};

// What never changes of the pairs of a hand.
struct PairBounds {
  std::vector<Body> bodies;
  std::vector<Pair> pairs;
};

class Pairs {
 private:
  const std::shared_ptr<const PairBounds> bounds_;

 public:
  const std::vector<Body>& bodies;
  const std::vector<Pair>& pairs;
  double margin = 0.0, horizon = kInfinity;

  Pairs(const Tree& tree, std::shared_ptr<const PairBounds> bounds)
      : bounds_(std::move(bounds)), bodies(bounds_->bodies), pairs(bounds_->pairs), tree_(tree),
        middle_(tree), known_(pairs.size()), keys_(pairs.size(), -kInfinity),
        levers_(pairs.size(), 0.0), centres_(bodies.size()), warm_(pairs.size()) {
    for (size_t k = 0; k < pairs.size(); ++k)
      for (const double lever : pairs[k].levers.values) levers_[k] += lever;
  }

  // Rows of the pairs that may come to their margin in the next displacement, where the robot is.
  void rows(const Placed& at, double dt, const Vector& margins, const Vector& last, Rows& rows) {
    go_to(at);
    const int n = tree_.size;
    const double reach = std::max(
        std::min(horizon == kInfinity ? kInfinity : kNear + kApproach * dt, horizon), kKept);
    turned_.resize(tree_.nv);
    tree_.expand(last.data(), turned_.data());
    for (double& turn : turned_) turn = std::abs(turn);
    const double most = longest_turn();
    rows.count = 0;
    rows.G.clear();
    rows.h.clear();
    for (size_t k = 0; k < pairs.size(); ++k) {
      const double kept = margins.empty() ? margin : margins[k];
      // At most, before the sum of levers times turns is known.
      double within = reach;
      if (reach < kInfinity) within = std::min(kNear + kExpected * levers_[k] * most, reach);
      if (bound(k) > kept + within || gap(k) > kept + within) continue;
      if (reach < kInfinity)
        within = std::min(kNear + kExpected * pairs[k].levers.dot(turned_.data()), reach);
      if (!is_within(at, k, kept + within)) continue;
      rows.G.resize((rows.count + 1) * n, 0.0);
      linearise(at, k, rows.G.data() + rows.count * n);
      rows.h.push_back(kGain * (known_[k].found.distance - kept));
      ++rows.count;
    }
  }

  // Whether no pair touches on a straight path from where the robot is to `end`, along a step of all
  // coordinates.
  bool is_clear(const Placed& at, const double* step, const Placed& end) {
    go_to(at);
    turned_.resize(tree_.nv);
    for (int c = 0; c < tree_.nv; ++c) turned_[c] = std::abs(step[c]);
    const double most = longest_turn();
    ends_.clear();
    parts_.clear();
    bool is_clear = true;
    for (size_t k = 0; k < pairs.size(); ++k) {
      const double farthest = kKept + levers_[k] * most;
      if (bound(k) > farthest || gap(k) > farthest) continue;
      const double travel = pairs[k].levers.dot(turned_.data());
      if (!is_within(at, k, kKept + travel)) continue;
      const Found &before = known_[k].found, after = found_at(end, k);
      ends_.push_back({k, after});
      // On a path from a to b, the distance is never below (a + b - travel) / 2.
      if (!(before.distance > 0.0 && before.distance + after.distance - travel < kKept)) continue;
      const double kept = std::min(before.distance, kKept);
      is_clear &= after.distance >= kept;
      parts_.push_back({0.0, 1.0, k, kept, before, after});
    }
    return is_clear && halve(at.q, step);
  }

  // The robot goes on to `at`. If that is where the last path ended but for a floating wrist, what
  // was found there moves with the wrist.
  void arrive(const Placed& at, const Placed& end) {
    if (q_.empty() || longest(at.q, end.q) != 0.0) return;
    const Pose moved = tree_.is_floating ? at.pose(0) * inverse(end.pose(0)) : Pose{};
    go_to(at);
    for (const auto& [k, found] : ends_)
      know(k, {found.distance, moved.R * found.normal, moved * found.point});
  }

 private:
  // What was found of a pair where the robot was at a stamp.
  struct Known {
    long stamp = -1;
    Found found{};
  };
  struct Part {
    double low, high;
    size_t pair;
    double kept;
    Found before, after;
  };

  // The largest difference of a joint's position; a floating wrist moves no pair.
  double longest(const Vector& a, const Vector& b) const {
    double most = 0.0;
    for (const Joint& joint : tree_.joints)
      if (joint.kind != JointKind::floating)
        most = std::max(most, std::abs(a[joint.q] - b[joint.q]));
    return most;
  }

  void go_to(const Placed& at) {
    if (q_ == at.q) return;
    if (!q_.empty()) turned_so_far_ += longest(q_, at.q);
    q_ = at.q;
    ++stamp_;
    for (size_t b = 0; b < bodies.size(); ++b)
      centres_[b] = at.pose(bodies[b].joint) * bodies[b].centre;
  }

  // A lower bound of the distance where the robot is: keys are bounds, plus the pair's levers times
  // how far the joints had turned since the beginning.
  double bound(size_t k) const { return keys_[k] - levers_[k] * turned_so_far_; }

  // The distance of the bounding balls of a pair that is not measured, as its new bound.
  double gap(size_t k) {
    if (known_[k].stamp == stamp_) return known_[k].found.distance;
    const int a = pairs[k].first, b = pairs[k].second;
    const double gap = norm(centres_[a] - centres_[b]) - bodies[a].radius - bodies[b].radius;
    keys_[k] = std::max(keys_[k], gap + levers_[k] * turned_so_far_);
    return gap;
  }

  // The longest turn of a joint in `turned_`; a floating wrist moves no pair.
  double longest_turn() const {
    double most = 0.0;
    for (const Joint& joint : tree_.joints)
      if (joint.kind != JointKind::floating) most = std::max(most, turned_[joint.v]);
    return most;
  }

  void know(size_t k, const Found& found) {
    known_[k] = {stamp_, found};
    keys_[k] = found.distance + levers_[k] * turned_so_far_;
  }

  // Whether a pair is within a distance where the robot is; if so, it is measured.
  bool is_within(const Placed& at, size_t k, double distance) {
    Known& known = known_[k];
    if (known.stamp != stamp_) {
      if (bound(k) > distance || gap(k) > distance) return false;
      know(k, found_at(at, k));
    }
    return known.found.distance <= distance;
  }

  Found found_at(const Placed& at, size_t k) {
    const Body &a = bodies[pairs[k].first], &b = bodies[pairs[k].second];
    return measure(a.shape, at.pose(a.joint) * a.placement, b.shape,
                   at.pose(b.joint) * b.placement, warm_[k]);
  }

  void linearise(const Placed& at, size_t k, double* row) const {
    const Found& found = known_[k].found;
    const Vec3 moment = cross(found.point, found.normal);
    const Sparse& signs = pairs[k].signs;
    for (size_t i = 0; i < signs.columns.size(); ++i) {
      const int c = signs.columns[i];
      const Twist& twist = at.columns[c];
      row[tree_.leader[c]] += tree_.factor[c] * signs.values[i] *
                              (dot(found.normal, twist.v) + dot(moment, twist.w));
    }
  }

  // Halve the parts of a path until each is shown to be clear, or a point of it is too near.
  bool halve(const Vector& start, const double* step) {
    int taken = 0;
    moved_.resize(tree_.nv);
    reached_.resize(tree_.nq);
    while (!parts_.empty()) {
      further_.clear();
      double at_low = -1.0;
      for (const Part& part : parts_) {
        const double length = part.high - part.low;
        const double travel = pairs[part.pair].levers.dot(turned_.data());
        const double bend = pairs[part.pair].turns.dot(turned_.data());
        const double turned = 2.0 * norm(part.after.normal - part.before.normal) + length * bend;
        const double nearest = std::min(part.before.distance, part.after.distance);
        if (!(nearest - 0.125 * turned * length * travel < 0.5 * part.kept)) continue;
        const double middle = 0.5 * (part.low + part.high);
        // All parts of one interval are halved at one point.
        if (at_low != part.low) {
          if (taken == kMostPoints) return false;
          ++taken;
          at_low = part.low;
          for (int c = 0; c < tree_.nv; ++c) moved_[c] = middle * step[c];
          tree_.integrate(start.data(), moved_.data(), reached_.data());
          middle_.place(reached_.data());
        }
        const Found between = found_at(middle_, part.pair);
        if (between.distance < part.kept) return false;
        further_.push_back({part.low, middle, part.pair, part.kept, part.before, between});
        further_.push_back({middle, part.high, part.pair, part.kept, between, part.after});
      }
      std::stable_sort(further_.begin(), further_.end(),
                       [](const Part& a, const Part& b) { return a.low < b.low; });
      std::swap(parts_, further_);
    }
    return true;
  }

  const Tree& tree_;
  Placed middle_;
  Vector q_;  // where the robot is
  double turned_so_far_ = 0.0;
  long stamp_ = 0;
  std::vector<Known> known_;
  Vector keys_, levers_;
  std::vector<Vec3> centres_;  // of the bodies' balls where the robot is
  std::vector<Warm> warm_;
  std::vector<std::pair<size_t, Found>> ends_;
  Vector turned_, moved_, reached_;
  std::vector<Part> parts_, further_;
};

}  // namespace handmap
