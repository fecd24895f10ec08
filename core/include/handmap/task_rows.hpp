// Rows of the tasks that the core has: distances of pairs of points, and the offset of one point from
// another. See handmap_core/ik/tasks.py.
#pragma once

#include <algorithm>
#include <array>
#include <iterator>

#include "tree.hpp"

namespace handmap {

// Length that counts as one in the cost [m].
constexpr double kLengthUnit = 0.01;

// A task's rows in the active coordinates, weighted: |jacobian dq + residual|^2 + dq^T diag(damping) dq.
struct TaskRows {
  int count = 0;
  Vector residual, jacobian, damping;
};

// Distances of pairs of points; see tasks.PointDistances.
struct DistanceTask {
  std::vector<Attached> points;
  std::vector<int> first, second;
};

// A task with its aims in one sample.
struct AimedDistances {
  const DistanceTask* task = nullptr;
  Vector aims, weights;

  void set(const DistanceTask& of, const Vector& aimed, const Vector& weighted) {
    task = &of;
    aims = aimed;
    weights = weighted;
  }
};

// Where a point of one hand should be from that of another; see tasks.PointOffset.
struct OffsetTask {
  Attached from, to;
  Vec3 aim;
  double weight;
};

// Set the levers of the active coordinates that move a joint to zero; `levers` has one for each of all.
inline void clear_levers(const Tree& tree, int joint, std::vector<Vec3>& levers) {
  levers.resize(tree.size);
  for (const int i : tree.moving_of(joint)) levers[i] = Vec3{};
}

// The rows of one pair of a task in one configuration: at most four, which few coordinates move.
class TaskBlock {
 public:
  int count = 0;                  // of the rows
  std::array<double, 4> errors{};
  std::vector<int> columns;       // active coordinates in which a row is not zero
  Vector rows;                    // shape (4, n), of which `columns` are set
  Vector damping;                 // shape (n,), likewise

  // The row of a distance, and three of its curvature.
  //
  // What a pair asks for may stay out of reach, and the hand must be free to move in other directions
  // all the same. So the cost has the distance's own curvature, its two parts each where they are
  // convex. For joints that others follow that is an estimate.
  void set_distance(const Placed& at, const DistanceTask& task, size_t pair, double aim,
                    double weight) {
    constexpr double kShortest = 1e-9;  // two points that are nearer have no direction [m]
    const Attached &a = task.points[task.first[pair]], &b = task.points[task.second[pair]];
    start(at.tree(), a.joint, b.joint);
    const Vec3 from = at.point(b), to = at.point(a);
    Vec3 offset = to - from;
    const double apart = std::max(norm(offset), kShortest);
    // Points in one place have no direction: any will do to part them.
    if (apart == kShortest) offset = {0.0, 0.0, kShortest};
    const Vec3 direction = (1.0 / apart) * offset;
    add_movers(at, a, b, to, from);
    weight /= kLengthUnit;
    const double residual = weight * (apart - aim);
    const double pull = std::sqrt(std::max(weight * residual / apart, 0.0));
    count = pull > 0.0 ? 4 : 1;
    errors = {residual, 0.0, 0.0, 0.0};
    const size_t n = levers_.size();
    for (const int i : movers_) {
      const Vec3 lever = levers_[i];
      if (norm(lever) == 0.0) continue;
      columns.push_back(i);
      const double slope = dot(direction, lever);
      rows[i] = weight * slope;
      // The second derivatives: of the offset's length, and of the offset along itself.
      const Vec3 across = pull * (lever - slope * direction);
      for (int axis = 0; axis < 3; ++axis) rows[(1 + axis) * n + i] = across[axis];
      const double bend = dot(direction, cross(turns_[i], lever));
      damping[i] = std::max(weight * residual * bend, 0.0);
    }
  }

  // A row for each axis of an offset.
  void set_offset(const Placed& at, const OffsetTask& task) {
    const Tree& tree = at.tree();
    start(tree, task.from.joint, task.to.joint);
    const Vec3 from = at.point(task.from), to = at.point(task.to);
    const Vec3 error = task.weight * (to - from - task.aim);
    for (const int c : tree.support_of(task.to.joint))
      levers_[tree.leader[c]] += (task.weight * tree.factor[c]) * at.velocity(c, to);
    for (const int c : tree.support_of(task.from.joint))
      levers_[tree.leader[c]] += (-task.weight * tree.factor[c]) * at.velocity(c, from);
    count = 3;
    errors = {error.x, error.y, error.z, 0.0};
    columns = movers_;
    for (const int i : columns)
      for (int axis = 0; axis < 3; ++axis) rows[axis * tree.size + i] = levers_[i][axis];
    for (const int i : columns) damping[i] = 0.0;
  }

 private:
  std::vector<Vec3> levers_, turns_;
  std::vector<int> movers_;  // active coordinates that move one of the points

  void start(const Tree& tree, int a, int b) {
    rows.resize(4 * tree.size);
    damping.resize(tree.size);
    for (std::vector<int>* each : {&columns, &movers_}) each->reserve(tree.size);
    columns.clear();
    for (std::vector<Vec3>* each : {&levers_, &turns_}) {
      clear_levers(tree, a, *each);
      clear_levers(tree, b, *each);
    }
    const std::vector<int>&by_a = tree.moving_of(a), &by_b = tree.moving_of(b);
    movers_.clear();
    std::set_union(by_a.begin(), by_a.end(), by_b.begin(), by_b.end(), std::back_inserter(movers_));
  }

  // Add what moves either of two points but not both: what moves both, such as a wrist, leaves their
  // distance.
  void add_movers(const Placed& at, const Attached& a, const Attached& b, const Vec3& to,
                  const Vec3& from) {
    const Tree& tree = at.tree();
    const std::vector<int>&by_a = tree.support_of(a.joint), &by_b = tree.support_of(b.joint);
    auto [own_a, own_b] = std::mismatch(by_a.begin(), by_a.end(), by_b.begin(), by_b.end());
    const auto add = [&](int c, double sign, const Vec3& point) {
      levers_[tree.leader[c]] += sign * tree.factor[c] * at.velocity(c, point);
      turns_[tree.leader[c]] += tree.factor[c] * at.columns[c].w;
    };
    for (; own_a != by_a.end(); ++own_a) add(*own_a, 1.0, to);
    for (; own_b != by_b.end(); ++own_b) add(*own_b, -1.0, from);
  }
};

// Add a row of all active coordinates.
inline void add_row(const TaskBlock& block, int row, TaskRows& to) {
  const size_t n = block.damping.size(), start = to.jacobian.size();
  to.residual.push_back(block.errors[row]);
  to.jacobian.resize(start + n, 0.0);
  for (const int i : block.columns) to.jacobian[start + i] = block.rows[row * n + i];
  ++to.count;
}

// All rows of distances: that of each pair, and three of the curvature of each.
inline TaskRows rows_of(const Placed& at, const AimedDistances& aimed) {
  const size_t pairs = aimed.task->first.size();
  std::vector<TaskBlock> blocks(pairs);
  TaskRows found;
  found.damping.assign(at.tree().size, 0.0);
  for (size_t k = 0; k < pairs; ++k) {
    blocks[k].set_distance(at, *aimed.task, k, aimed.aims[k], aimed.weights[k]);
    add_row(blocks[k], 0, found);
    for (const int i : blocks[k].columns) found.damping[i] += blocks[k].damping[i];
  }
  for (const TaskBlock& block : blocks)
    for (int row = 1; row < 4; ++row) add_row(block, row, found);
  return found;
}

// All rows of an offset.
inline TaskRows rows_of(const Placed& at, const OffsetTask& task) {
  TaskBlock block;
  block.set_offset(at, task);
  TaskRows found;
  found.damping.assign(at.tree().size, 0.0);
  for (int row = 0; row < block.count; ++row) add_row(block, row, found);
  return found;
}

}  // namespace handmap
