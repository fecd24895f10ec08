// Inverse kinematics of one sample: see handmap_qp/ik/qp.py, whose names these are.
#pragma once

#include <cstdint>
#include <functional>
#include <limits>
#include <optional>

#include "detour_state.hpp"
#include "gate.hpp"
#include "guessed_qp.hpp"
#include "reused_list.hpp"
#include "task_rows.hpp"

namespace handmap {

struct Weights {
  Vector points;  // cost of each reference point's error [cost]/[m]
  double wrist_position, wrist_orientation;  // [cost]/[m], [cost]/[rad]
  double damping, error_damping;
};

struct Settings {
  int max_iterations;
  double step_tolerance, point_tolerance;
  double rest_weight, speed_weight, acceleration_weight;
  bool points_follow_wrist;
};

struct Posture {
  double weight = 0.0;
  Vector q;       // in the user's order of joints
  Vector shares;  // of the weight, of each joint; all of it if empty
};

// What is done for one sample, at most: iterations of the QP, solutions with further rows of what comes
// too near where the step ends, and ways around what meets on it; and whether the step is proved clear.
struct Effort {
  int iterations = std::numeric_limits<int>::max(), looks = kLooks, tries = kTries;
  bool proves = true;
};
// Enough to foresee where a hand comes to, at a tenth of the cost; a hand moves by all of it.
constexpr Effort kRough{1, 1, 0, false};

// What the cost of one sample asks for.
struct Goal {
  std::vector<Vec3> points;
  std::vector<Pose> wrists;  // of each hand; empty where they are free
  ReusedList<Posture> postures;
  ReusedList<AimedDistances> distances;
  std::vector<OffsetTask> offsets;
  // Further rows at a configuration, of tasks written elsewhere.
  std::function<void(const Vector& q, TaskRows& rows)> further;
  Vector damping_shares;  // of the damping's weight, of each joint; all of it if empty

  // Take shares of the weights of the rest term, which is the first posture, and of the damping.
  void regularise(const Vector& shares) {
    postures[0].shares = shares;
    damping_shares = shares;
  }
  // Pull joints to a posture by shares of a weight.
  void pull(double weight, const Vector& q, const Vector& shares) {
    Posture& posture = postures.add();
    posture.weight = weight;
    posture.q = q;
    posture.shares = shares;
  }
};

enum class Status { converged, limited, unreachable, unsettled, failed, released };
constexpr const char* kStatusNames[] = {"converged", "limited", "unreachable",
                                        "unsettled", "failed",  "released"};
inline const char* name_of(Status status) { return kStatusNames[static_cast<int>(status)]; }

struct Result {
  Status status;
  std::vector<Vec3> points, targets;
  std::vector<Pose> wrists;
  Vector displacement;
  std::vector<std::int8_t> active;
  int iterations;
  double last_step;
  int held_by;  // the pair of shapes that holds the hand back, or -1

  void reserve(const Tree& tree) {
    for (std::vector<Vec3>* each : {&points, &targets}) each->reserve(tree.points.size());
    wrists.reserve(tree.parts.size());
    displacement.reserve(static_cast<size_t>(tree.size));
    active.reserve(static_cast<size_t>(tree.size));
  }
};

// Memory in which the detours of one hand are sought; see detours.hpp.
struct DetourWork {
  Goal goal;        // that of the sample, with another posture
  Vector errors;    // of the hand where it is [cost]
  Result foreseen;  // of a QP that moves no hand
};

// Moves a robot by QPs, through its gate.
class Ik : public Gate {
 public:
  Weights weights;
  Settings settings;
  bool takes_detours = false;
  std::vector<Detour> detours;  // of each hand
  std::vector<DetourWork> detour_work;
  Motion sought_from;  // where the robot was before the last `seek`

  explicit Ik(Tree given) : Gate(std::move(given)), detour_work(tree.parts.size()) {}

  // Make room for samples, so that none after the first takes memory; call it with pairs and options set.
  void reserve() {
    const size_t n = static_cast<size_t>(tree.size), rows = pairs ? kUsualRows : 0;
    reserve_gate();
    linear_.reserve(n, rows);
    h_.reserve(rows);
    qp_.reserve(n, rows);
    columns_.reserve(n);
    for (DetourWork& work : detour_work) work.foreseen.reserve(tree);
  }

  // Move the hand towards its targets for one sample.
  void solve(const Goal& goal, const When& when, const Vector& margins, double speed,
             Result& result, const Effort& effort = {}) {
    const Interval interval = motion.next(when);
    const double dt = interval.dt;
    at.place(motion.q.data());
    bounds(interval, speed, lower_, upper_);
    const int n = tree.size;
    bool has_rows = false;
    qp_.forget_rows();
    if (pairs) {
      start.copy(at);
      pairs->rows(start, dt, margins, motion.displacement, linear_);
      has_rows = linear_.count > 0;
    }
    total_.assign(n, 0.0);
    first_.assign(n, 0.0);
    // Joints on a bound often stay on it.
    expected_.resize(n);
    for (int i = 0; i < n; ++i) expected_[i] = motion.displacement[i] / motion.dt * dt;
    least_.resize(n);
    most_.resize(n);
    int iterations = 0;
    double last_step = kInfinity;
    bool has_failed = false;
    const int most_iterations = std::min(settings.max_iterations, effort.iterations);
    while (last_step > settings.step_tolerance && iterations < most_iterations) {
      // Leave later iterations the rest of the bounds, which hold for the whole sample.
      for (int i = 0; i < n; ++i) {
        least_[i] = lower_[i] - total_[i];
        most_[i] = upper_[i] - total_[i];
      }
      if (has_rows) loosen(linear_, interval, least_, most_, total_, h_);
      double length2;
      cost(goal);
      has_failed = !minimise(has_rows ? linear_.count : 0, length2);
      ++iterations;
      // On failure, bring joints outside their limits back all the same.
      for (int i = 0; i < n; ++i)
        total_[i] = clip(has_failed ? 0.0 : total_[i] + qp_.x[i], lower_[i], upper_[i]);
      last_step = has_failed ? 0.0 : std::sqrt(length2);
      if (iterations == 1) first_ = total_;
      expected_ = total_;
      at.displace(motion.q.data(), total_.data());
    }
    // Later iterations leave the cost of another posture.
    bool has_first_cost = iterations == 1;
    // Solve from the start again, with rows of the points that met.
    const auto solve_again = [&] {
      double length2;
      total_.assign(n, 0.0);
      loosen(linear_, interval, lower_, upper_, total_, h_);
      least_ = lower_;
      most_ = upper_;
      if (!has_first_cost) {
        at.copy(start);
        cost(goal);
      }
      const bool has_step = minimise(linear_.count, length2, has_first_cost);
      has_first_cost = true;
      ++iterations;
      for (int i = 0; i < n; ++i)
        total_[i] = clip(has_step ? qp_.x[i] : 0.0, lower_[i], upper_[i]);
    };
    // See qp.PointIk._solve_here.
    for (int look = 0; has_rows && look < effort.looks; ++look) {
      if (!add_rows_at_end(total_, linear_)) break;
      solve_again();
      first_ = total_;
      at.displace(motion.q.data(), total_.data());
    }
    const auto go_around = [&]() -> const Vector& {
      add_rows_on_line(linear_);
      solve_again();
      return total_;
    };
    if (effort.proves)
      admit(total_, first_, interval, go_around, effort.tries);
    else
      move_unproved(total_, interval);
    if (effort.proves && held_by < 0 && is_pressed_)
      held_by = pressed_pair(linear_, h_, qp_.slope(kTight), qp_.x);
    at.place(motion.q.data());
    if (pairs && effort.proves) pairs->arrive(at, path_end);
    finish(goal, iterations, last_step, has_failed, result);
  }

  // Take the stop that was admitted last, for one sample.
  void hold(const When& when, Result& result) {
    brake(when);
    at.place(motion.q.data());
    result.points.resize(tree.points.size());
    for (size_t k = 0; k < tree.points.size(); ++k) result.points[k] = at.point(tree.points[k]);
    result.targets = result.points;
    place_wrists(result);
    result.displacement = motion.displacement;
    result.active.assign(tree.size, 0);
    result.iterations = 0;
    result.last_step = 0.0;
    result.held_by = -1;
    result.status = Status::released;
  }

  // Something else moves the hand.
  void stop_detours() { detours.assign(tree.parts.size(), {}); }

  // Write what the cost of a sample pulls to: the rest posture; where the hand is, because displacement
  // costs; and where it would go on to, because a change of displacement costs.
  void set_postures(const Vector& rest, double dt, ReusedList<Posture>& to) const {
    to.clear();
    const auto add = [&to](double weight) -> Vector& {
      Posture& posture = to.add();
      posture.weight = weight;
      posture.shares.clear();
      return posture.q;
    };
    add(settings.rest_weight) = rest;
    if (settings.speed_weight == 0.0 && settings.acceleration_weight == 0.0) return;
    const auto start = [this](size_t j) { return motion.q[tree.q_indices[j]]; };
    const size_t joints = tree.q_indices.size();
    Vector& here = add(settings.speed_weight);
    here.resize(joints);
    for (size_t j = 0; j < joints; ++j) here[j] = start(j);
    Vector& ahead = add(settings.acceleration_weight);
    ahead.resize(joints);
    for (size_t j = 0; j < joints; ++j)
      ahead[j] = start(j) + dt * (motion.displacement[tree.joint_columns[j]] / motion.dt);
  }

  std::int64_t costs = 0;  // number of costs that were computed, as a measure of work

  void was_moved() override { stop_detours(); }

 private:
  // Solve the QP of one iteration, whose cost is known: false if that fails. `has_other_rows` as of
  // `GuessedQp::solve`.
  bool minimise(int rows, double& length2, bool has_other_rows = false) {
    length2 = 0.0;
    is_pressed_ = false;
    guess();
    if (!qp_.solve(tree.size, H_.data(), c_.data(), least_.data(), most_.data(), rows,
                   linear_.G.data(), h_.data(), guess_, has_other_rows))
      return false;
    for (const double x : qp_.x) length2 += x * x;
    is_pressed_ = std::isfinite(length2) && qp_.has_active_row();
    return std::isfinite(length2);
  }

  // Guess which coordinates end on a bound, from the displacement that is expected.
  void guess() {
    constexpr double kRelative = 1e-9, kAbsolute = 1e-12;
    guess_.resize(tree.size);
    for (int i = 0; i < tree.size; ++i) {
      const double low = lower_[i], high = upper_[i], expected = expected_[i];
      const bool is_low = expected <= low + (kRelative * std::abs(low) + kAbsolute);
      const bool is_high = expected >= high - (kRelative * std::abs(high) + kAbsolute);
      guess_[i] = static_cast<signed char>(is_low ? -1 : is_high);
    }
  }

  // Add rows of one block, nonzero in `columns_` only, to the cost.
  void add_rows(const double* rows, int count, const double* errors) {
    const int n = tree.size;
    const int used = static_cast<int>(columns_.size());
    for (int r = 0; r < count; ++r) {
      const double* row = rows + r * n;
      for (int a = 0; a < used; ++a) {
        const int i = columns_[a];
        const double value = row[i];
        c_[i] += errors[r] * value;
        double* to = H_.data() + i * n;
        for (int b = 0; b <= a; ++b) to[columns_[b]] += value * row[columns_[b]];
      }
    }
  }

  void start_levers(int joint) { clear_levers(tree, joint, levers_); }

  // Add three rows of the cost: `levers_` of the active coordinates that move a joint.
  void add_levers(int joint, const Vec3& error) {
    if (joint < 0) return;
    const std::vector<int>& moving = tree.moving[joint];
    for (size_t a = 0; a < moving.size(); ++a) {
      const Vec3 lever = levers_[moving[a]];
      levers2_[moving[a]] += dot(lever, lever);
      c_[moving[a]] += dot(error, lever);
      double* row = H_.data() + moving[a] * tree.size;
      for (size_t b = 0; b <= a; ++b) row[moving[b]] += dot(lever, levers_[moving[b]]);
    }
  }

  // c and the lower triangle of H of the QP where the hand is.
  void cost(const Goal& goal) {
    const int n = tree.size;
    ++costs;
    H_.assign(n * n, 0.0);
    c_.assign(n, 0.0);
    diagonal_.assign(n, weights.damping * weights.damping);
    for (size_t j = 0; j < tree.joint_columns.size(); ++j) {
      const double share = goal.damping_shares.empty() ? 1.0 : goal.damping_shares[j];
      const double weight = share * tree.joint_weights[j];
      diagonal_[tree.joint_columns[j]] *= weight * weight;
    }
    place_targets(goal);
    for (size_t i = 0; i < tree.parts.size(); ++i) {
      damp(add_points(tree.parts[i], is_carried(goal)));
      if (!goal.wrists.empty()) damp(add_wrist(tree.parts[i], goal.wrists[i]));
    }
    for (const Posture& posture : goal.postures) {
      for (size_t j = 0; j < tree.joint_columns.size(); ++j) {
        const int i = tree.joint_columns[j];
        const double share = posture.shares.empty() ? 1.0 : posture.shares[j];
        const double weight = posture.weight * share * tree.joint_weights[j];
        const double weight2 = weight * weight;
        diagonal_[i] += weight2;
        c_[i] += weight2 * (at.q[tree.q_indices[j]] - posture.q[j]);
      }
    }
    for (const AimedDistances& aimed : goal.distances)
      for (size_t k = 0; k < aimed.weights.size(); ++k) {
        if (aimed.weights[k] == 0.0) continue;
        block_.set_distance(at, *aimed.task, k, aimed.aims[k], aimed.weights[k]);
        add_block();
      }
    for (const OffsetTask& offset : goal.offsets) {
      block_.set_offset(at, offset);
      add_block();
    }
    if (goal.further) {
      goal.further(at.q, further_);
      columns_.resize(n);
      for (int i = 0; i < n; ++i) columns_[i] = i;
      add_rows(further_.jacobian.data(), further_.count, further_.residual.data());
      for (int i = 0; i < n; ++i) diagonal_[i] += further_.damping[i];
    }
    for (int i = 0; i < n; ++i) H_[i * n + i] += diagonal_[i];
  }

  // Damp points or wrist by their error times lever, the curvature that the linearisation neglects.
  // A floating wrist's translation has none.
  void damp(double error2) {
    const double scale = weights.error_damping * std::sqrt(error2);
    for (int i = tree.is_floating ? 3 : 0; i < tree.size; ++i)
      diagonal_[i] += scale * std::sqrt(levers2_[i]);
  }

  // Whether the points' targets go with the wrists.
  bool is_carried(const Goal& goal) const {
    return settings.points_follow_wrist && !goal.wrists.empty();
  }

  // Find where the points' targets are: those that go with a wrist, on it where it is.
  void place_targets(const Goal& goal) {
    targets_ = goal.points;
    for (size_t i = 0; is_carried(goal) && i < tree.parts.size(); ++i) {
      const Part& part = tree.parts[i];
      const Pose drift = at.wrist(part) * inverse(goal.wrists[i]);
      for (size_t k = part.first; k < part.end; ++k) targets_[k] = drift * targets_[k];
    }
  }

  void place_wrists(Result& result) const {
    result.wrists.clear();
    for (const Part& part : tree.parts) result.wrists.push_back(at.wrist(part));
  }

  double add_points(const Part& part, bool is_carried) {
    double error2 = 0.0;
    levers2_.assign(tree.size, 0.0);
    for (size_t k = part.first; k < part.end; ++k) {
      const Attached& attached = tree.points[k];
      const Vec3 point = at.point(attached);
      const Vec3 error = weights.points[k] * (point - targets_[k]);
      error2 += dot(error, error);
      start_levers(attached.joint);
      for (const int c : tree.support_of(attached.joint))
        levers_[tree.leader[c]] += (weights.points[k] * tree.factor[c]) * at.velocity(c, point);
      // What moves the wrist moves the targets too.
      if (is_carried) start_levers(part.joint);
      add_levers(attached.joint, error);
    }
    return error2;
  }

  double add_wrist(const Part& part, const Pose& target) {
    const Pose here = at.wrist(part), offset = inverse(target) * here;
    const Twist twist = log6(offset);
    const LogJacobian log = jlog6(offset);
    const double a = weights.wrist_position, b = weights.wrist_orientation;
    levers2_.assign(tree.size, 0.0);
    const int joint = part.joint;
    const Vec3 v = a * twist.v, w = b * twist.w;
    // The columns' velocities in the wrist's axes.
    start_levers(joint);
    for (const int c : tree.support_of(joint)) {
      const Vec3 angular = tmul(here.R, at.columns[c].w);
      const Vec3 linear = tmul(here.R, at.velocity(c, here.p));
      levers_[tree.leader[c]] += (a * tree.factor[c]) * (log.A * linear + log.B * angular);
    }
    add_levers(joint, v);
    start_levers(joint);
    for (const int c : tree.support_of(joint))
      levers_[tree.leader[c]] +=
          (b * tree.factor[c]) * (log.A * tmul(here.R, at.columns[c].w));
    add_levers(joint, w);
    return dot(v, v) + dot(w, w);
  }

  // Add the rows of `block_`.
  void add_block() {
    columns_ = block_.columns;
    add_rows(block_.rows.data(), block_.count, block_.errors.data());
    for (const int i : columns_) diagonal_[i] += block_.damping[i];
  }

  void finish(const Goal& goal, int iterations, double last_step, bool has_failed, Result& result) {
    constexpr double kAtBound = 1e-7, kAtRest = 1e-3;
    const int n = tree.size;
    result.points.resize(tree.points.size());
    place_targets(goal);
    result.targets = targets_;
    double farthest2 = 0.0;
    for (size_t k = 0; k < tree.points.size(); ++k) {
      result.points[k] = at.point(tree.points[k]);
      const Vec3 error = result.points[k] - result.targets[k];
      farthest2 = std::max(farthest2, dot(error, error));
    }
    place_wrists(result);
    for (size_t i = 0; is_carried(goal) && i < tree.parts.size(); ++i) {
      // See qp.wrist_error and WRIST_LEVERS.
      const Pose &here = result.wrists[i], &target = goal.wrists[i];
      const Vec3 off = here.p - target.p, turn = log3(transposed(target.R) * here.R);
      farthest2 = std::max({farthest2, dot(off, off), 0.01 * dot(turn, turn)});
    }
    result.displacement = motion.displacement;
    result.active.resize(n);
    bool at_bound = false;
    for (int i = 0; i < n; ++i) {
      const double width = std::min(upper_[i] - lower_[i], 1.0), x = motion.displacement[i];
      const int high = upper_[i] - x <= kAtBound * width, low = x - lower_[i] <= kAtBound * width;
      result.active[i] = static_cast<std::int8_t>(high - low);
      at_bound |= high != low;
    }
    result.iterations = iterations;
    result.last_step = last_step;
    result.held_by = held_by;
    result.status = has_failed                                              ? Status::failed
                    : std::sqrt(farthest2) <= settings.point_tolerance ? Status::converged
                    : at_bound                                              ? Status::limited
                    : last_step <= kAtRest                                  ? Status::unreachable
                                                                            : Status::unsettled;
  }

  GuessedQp qp_;
  Rows linear_;
  TaskRows further_;
  bool is_pressed_ = false;  // whether a row is active in the last step
  std::vector<int> columns_;
  std::vector<signed char> guess_;
  std::vector<Vec3> levers_, targets_;
  Vector levers2_, lower_, upper_, expected_, total_, first_, least_, most_, h_, H_, c_, diagonal_;
  TaskBlock block_;
};

}  // namespace handmap
