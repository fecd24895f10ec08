// Postures and gaps of a hand that are solved or measured outside a stream: see
// handmap_qp/ik/nearest_posture.py and apps/offline/surface_gaps.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

#include "ik.hpp"

namespace handmap {

constexpr int kMostSteps = 50;
constexpr double kSmallestStep = 1e-8;  // [rad or m]
// Share of the decrease that the slope foretells (Armijo), and the least share of a step to try.
constexpr double kLeastDecrease = 1e-4, kSmallestShare = 1e-4;
// Near the minimum, values differ by less than their rounding.
constexpr double kRounded = 1.0 + 1e-14;
// Least eigenvalue of the Hessian over its largest; smaller ones are turned or lifted.
constexpr double kLeastCurvature = 1e-6;

// The posture in which a hand's points are nearest to their targets, by Newton's method.
class NearestPosture {
 public:
  std::vector<Vec3> targets;
  Vector costs;      // of each point's error, squared
  double rest_cost;  // squared

  explicit NearestPosture(const Tree& tree) : tree_(tree), placed_(tree) {}

  // `start` and the result are joint positions in the user's order.
  Vector solve(const Vector& start) {
    find_free();
    const size_t n = free_.size();
    Vector x(n), low(n), high(n), step, ahead(n);
    for (size_t i = 0; i < n; ++i)
      x[i] = std::clamp(start[free_[i]], tree_.lower[free_[i]], tree_.upper[free_[i]]);
    Terms here = at(x);
    for (int round = 0; round < kMostSteps; ++round) {
      for (size_t i = 0; i < n; ++i) {
        low[i] = tree_.lower[free_[i]] - x[i];
        high[i] = tree_.upper[free_[i]] - x[i];
      }
      make_convex(here.hessian, n);
      if (!qp_.solve(static_cast<int>(n), here.hessian.data(), here.gradient.data(), low.data(),
                     high.data(), 0, nullptr, nullptr))
        break;
      step = qp_.x;
      const double slope = std::inner_product(step.begin(), step.end(), here.gradient.begin(), 0.0);
      Terms there;
      for (double share = 1.0;;) {
        for (size_t i = 0; i < n; ++i)
          ahead[i] = std::clamp(x[i] + share * step[i], tree_.lower[free_[i]], tree_.upper[free_[i]]);
        there = at(ahead);
        if (there.value <= kRounded * here.value + kLeastDecrease * share * slope) break;
        share *= 0.5;
        if (share < kSmallestShare) return whole(x);
      }
      double length = 0.0;
      for (size_t i = 0; i < n; ++i) length = std::max(length, std::abs(ahead[i] - x[i]));
      x = ahead;
      here = std::move(there);
      if (length < kSmallestStep) break;
    }
    return whole(x);
  }

 private:
  struct Terms {
    double value = 0.0;
    Vector gradient, hessian;
  };

  // Joints that do not move the wrist, and the tangent coordinates that they move.
  void find_free() {
    std::vector<char> is_fixed(tree_.size, 0);
    if (tree_.wrist_origin.joint >= 0)
      for (const int c : tree_.supports[tree_.wrist_origin.joint]) is_fixed[tree_.leader[c]] = 1;
    place_of_.assign(tree_.size, -1);
    for (size_t i = 0; i < tree_.joint_columns.size(); ++i) {
      const int column = tree_.joint_columns[i];
      if (is_fixed[column]) continue;
      place_of_[column] = static_cast<int>(free_.size());
      free_.push_back(static_cast<int>(i));
    }
  }

  Vector whole(const Vector& x) const {
    Vector q = tree_.joint_rest;
    for (size_t i = 0; i < free_.size(); ++i) q[free_[i]] = x[i];
    return q;
  }

  int place_of(int coordinate) const { return place_of_[tree_.leader[coordinate]]; }

  Terms at(const Vector& x) {
    const size_t n = free_.size();
    displacement_.assign(tree_.size, 0.0);
    for (size_t i = 0; i < n; ++i)
      displacement_[tree_.joint_columns[free_[i]]] = x[i] - tree_.joint_rest[free_[i]];
    placed_.displace(tree_.rest.data(), displacement_.data());
    Terms terms;
    terms.gradient.resize(n);
    terms.hessian.assign(n * n, 0.0);
    turning_.assign(tree_.nv, Vec3{});
    double cost = 0.0, moved = 0.0;
    std::vector<Vec3> levers(n);
    for (size_t k = 0; k < tree_.points.size(); ++k) {
      const Vec3 point = placed_.point(tree_.points[k]), error = point - targets[k];
      const Vec3 force = costs[k] * error;
      cost += dot(force, error);
      std::fill(levers.begin(), levers.end(), Vec3{});
      if (tree_.points[k].joint < 0) continue;
      for (const int c : tree_.supports[tree_.points[k].joint]) {
        if (place_of(c) < 0) continue;
        const Vec3 velocity = placed_.velocity(c, point);
        levers[place_of(c)] += tree_.factor[c] * velocity;
        turning_[c] += cross(velocity, force);
      }
      for (size_t i = 0; i < n; ++i) {
        terms.gradient[i] += dot(force, levers[i]);
        for (size_t j = 0; j < n; ++j)
          terms.hessian[i * n + j] += costs[k] * dot(levers[i], levers[j]);
      }
    }
    // Of coordinates c and d of which c moves d, the axis of c times what d turns.
    for (const Joint& joint : tree_.joints) {
      const int d = joint.v;
      if (joint.kind == JointKind::floating || place_of(d) < 0) continue;
      for (const int c : tree_.supports[&joint - tree_.joints.data()]) {
        if (place_of(c) < 0) continue;
        const double bend =
            tree_.factor[c] * tree_.factor[d] * dot(placed_.columns[c].w, turning_[d]);
        terms.hessian[place_of(c) * n + place_of(d)] += bend;
        if (c != d) terms.hessian[place_of(d) * n + place_of(c)] += bend;
      }
    }
    for (size_t i = 0; i < n; ++i) {
      const double away = x[i] - tree_.joint_rest[free_[i]];
      moved += away * away;
      terms.gradient[i] += rest_cost * away;
      terms.hessian[i * n + i] += rest_cost;
    }
    terms.value = 0.5 * (cost + rest_cost * moved);
    return terms;
  }

  static bool is_convex(Vector a, size_t n) {
    for (size_t j = 0; j < n; ++j) {
      double pivot = a[j * n + j];
      for (size_t k = 0; k < j; ++k) pivot -= a[j * n + k] * a[j * n + k];
      if (!(pivot > 0.0)) return false;
      a[j * n + j] = std::sqrt(pivot);
      for (size_t i = j + 1; i < n; ++i) {
        for (size_t k = 0; k < j; ++k) a[i * n + j] -= a[i * n + k] * a[j * n + k];
        a[i * n + j] /= a[j * n + j];
      }
    }
    return true;
  }

  // Turn or lift the eigenvalues of a symmetric matrix that are not positive (Jacobi's method).
  void make_convex(Vector& a, size_t n) const {
    if (is_convex(a, n)) return;
    Vector vectors(n * n, 0.0);
    for (size_t i = 0; i < n; ++i) vectors[i * n + i] = 1.0;
    for (int sweep = 0; sweep < 50; ++sweep) {
      bool turned = false;
      for (size_t p = 0; p + 1 < n; ++p)
        for (size_t q = p + 1; q < n; ++q) {
          const double pq = a[p * n + q], pp = a[p * n + p], qq = a[q * n + q];
          if (!(std::abs(pq) > 1e-17 * (std::abs(pp) + std::abs(qq)))) continue;
          turned = true;
          const double zeta = (qq - pp) / (2.0 * pq);
          const double t =
              std::copysign(1.0, zeta) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
          const double c = 1.0 / std::sqrt(1.0 + t * t), s = c * t;
          for (size_t i = 0; i < n; ++i) turn(a[i * n + p], a[i * n + q], c, s);
          for (size_t i = 0; i < n; ++i) turn(a[p * n + i], a[q * n + i], c, s);
          for (size_t i = 0; i < n; ++i) turn(vectors[i * n + p], vectors[i * n + q], c, s);
        }
      if (!turned) break;
    }
    Vector values(n);
    double largest = 0.0;
    for (size_t i = 0; i < n; ++i) {
      values[i] = std::abs(a[i * n + i]);
      largest = std::max(largest, values[i]);
    }
    for (size_t i = 0; i < n; ++i)
      for (size_t j = 0; j < n; ++j) {
        double sum = 0.0;
        for (size_t k = 0; k < n; ++k)
          sum += vectors[i * n + k] * std::max(values[k], kLeastCurvature * largest) *
                 vectors[j * n + k];
        a[i * n + j] = sum;
      }
  }

  static void turn(double& x, double& y, double c, double s) {
    const double before = x;
    x = c * x - s * y;
    y = s * before + c * y;
  }

  const Tree& tree_;
  Placed placed_;
  Qp qp_;
  std::vector<int> free_, place_of_;
  Vector displacement_;
  std::vector<Vec3> turning_;
};

// Whether all distances that have a weight are within a tolerance of their aims; false for NaN.
inline bool is_reached(const AimedDistances& aimed, const Placed& at, double tolerance) {
  const DistanceTask& task = *aimed.task;
  for (size_t k = 0; k < aimed.aims.size(); ++k) {
    if (aimed.weights[k] == 0.0) continue;
    const Vec3 apart = at.point(task.points[task.first[k]]) - at.point(task.points[task.second[k]]);
    if (!(std::abs(norm(apart) - aimed.aims[k]) < tolerance)) return false;
  }
  return true;
}

// Move a hand, whose wrist should stay and whose joints go to `rest`, for so many samples, or until
// distances are within a tolerance of their aims; see hand_pair.RobotFingers.pinches.
inline void approach(Ik& ik, const AimedDistances& aimed, const Vector& rest, double dt, int samples,
                     double tolerance) {
  Placed placed(ik.tree);
  placed.place(ik.motion.q.data());
  Goal goal;
  goal.wrists = {placed.wrist()};
  goal.distances.add() = aimed;
  for (const Attached& point : ik.tree.points) goal.points.push_back(placed.point(point));
  Result result;
  for (int k = 0; k < samples; ++k) {
    ik.set_postures(rest, dt, goal.postures);
    ik.solve(goal, When::after(dt), {}, 1.0, result);
    placed.place(ik.motion.q.data());
    if (is_reached(aimed, placed, tolerance)) return;
  }
}

// Smallest distances of pairs in many postures, one after the other. A pair is measured only if it is
// not known to be farther apart: by its balls, or along the direction that parted it last.
class SmallestDistances {
 public:
  explicit SmallestDistances(const PairBounds& bounds)
      : bounds_(bounds), partings_(bounds.pairs.size()), centres_(bounds.bodies.size()) {}

  // That of all pairs in one posture, or `most` if none is nearer.
  double measure(const Placed& at, double most) {
    at_ = &at;
    for (size_t i = 0; i < centres_.size(); ++i)
      centres_[i] = at.pose(bounds_.bodies[i].joint) * bounds_.bodies[i].centre;
    order_.clear();
    for (size_t k = 0; k < bounds_.pairs.size(); ++k) {
      const int a = bounds_.pairs[k].first, b = bounds_.pairs[k].second;
      const double reach = bounds_.bodies[a].radius + bounds_.bodies[b].radius;
      const double gap = norm(centres_[a] - centres_[b]) - reach;
      if (gap < most) order_.push_back({gap, k});
    }
    std::sort(order_.begin(), order_.end());
    for (const auto& [gap, k] : order_) {
      if (gap >= most) break;
      if (parted(k) < most) most = std::min(most, measured(k));
    }
    return most;
  }

 private:
  // A lower bound of the distance; where nothing has parted the bodies yet, along their centres.
  double parted(size_t k) {
    const int first = bounds_.pairs[k].first, second = bounds_.pairs[k].second;
    const Body &a = bounds_.bodies[first], &b = bounds_.bodies[second];
    const Pose &to_a = at_->pose(a.joint), &to_b = at_->pose(b.joint);
    Vec3 d = to_a.R * partings_[k];
    if (dot(d, d) == 0.0) {
      d = centres_[second] - centres_[first];
      const double length = norm(d);
      if (!(length > 0.0)) return -kInfinity;
      d *= 1.0 / length;
    }
    return dot(d, to_b.p - to_a.p) - reach_of(a, tmul(to_a.R, d)) -
           reach_of(b, -tmul(to_b.R, d));
  }

  double measured(size_t k) {
    const Body &a = bounds_.bodies[bounds_.pairs[k].first],
               &b = bounds_.bodies[bounds_.pairs[k].second];
    const Pose &to_a = at_->pose(a.joint), &to_b = at_->pose(b.joint);
    Warm warm{};
    const Found found = handmap::measure(a.shape, to_a * a.placement, b.shape, to_b * b.placement,
                                         warm, expansion_);
    partings_[k] = tmul(to_a.R, found.normal);
    return found.distance;
  }

  const PairBounds& bounds_;
  std::vector<Vec3> partings_;  // from the first body to the second, in the axes of the first one's joint
  std::vector<Vec3> centres_;
  std::vector<std::pair<double, size_t>> order_;
  Expansion expansion_;
  const Placed* at_ = nullptr;
};

}  // namespace handmap
