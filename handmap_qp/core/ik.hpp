// Inverse kinematics of one sample: see handmap_qp/ik/qp.py and limits.py, whose names these are.
#pragma once

#include <cstdint>
#include <functional>
#include <iterator>
#include <memory>
#include <numeric>
#include <optional>

#include "guessed_qp.hpp"
#include "pairs.hpp"

namespace handmap {

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
  const DistanceTask* task;
  Vector aims, weights;
};

// Where a point of one hand should be from that of another; see tasks.PointOffset.
struct OffsetTask {
  Attached from, to;
  Vec3 aim;
  double weight;
};

// Length that counts as one in the cost [m].
constexpr double kLengthUnit = 0.01;

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
  double weight;
  Vector q;            // in the user's order of joints
  Vector shares = {};  // of the weight, of each joint; all of it if empty
};

// What the cost of one sample asks for.
struct Goal {
  std::vector<Vec3> points;
  std::vector<Pose> wrists;  // of each hand; empty where they are free
  std::vector<Posture> postures;
  std::vector<AimedDistances> distances;
  std::vector<OffsetTask> offsets;
  // Further rows at a configuration, of tasks written elsewhere.
  std::function<void(const Vector& q, TaskRows& rows)> further;
  Vector damping_shares;  // of the damping's weight, of each joint; all of it if empty

  // Take shares of the weights of the rest term, which is the first posture, and of the damping.
  void regularise(const Vector& shares) {
    postures.front().shares = shares;
    damping_shares = shares;
  }
};

// The constants of collision.py, by their names there.
struct DetourRules {
  double away, on_its_way, sample, again, later, of_point, of_all, pull, reached, moved, grown,
      forgotten;
  int samples, longest;
};

// Of one hand; see collision.Detour.
struct Detour {
  Vector via;
  std::vector<Vec3> points;
  Vector known;
  double left = 0.0, wait = 0.0;
};

enum class Status { converged, limited, unreachable, unsettled, failed, released };

struct Result {
  Status status;
  std::vector<Vec3> points, targets;
  std::vector<Pose> wrists;
  Vector displacement;
  std::vector<std::int8_t> active;
  int iterations;
  double last_step;
  int held_by;  // the pair of shapes that holds the hand back, or -1
};

class Ik {
 public:
  Tree tree;
  Weights weights;
  Settings settings;
  BoxLimits limits;
  std::unique_ptr<Pairs> pairs;
  Motion motion;
  std::optional<DetourRules> detour_rules;
  std::vector<Detour> detours;  // of each hand
  std::vector<Vector> fingers;  // of each hand, of each joint: see Hand.finger_joints

  explicit Ik(Tree given)
      : tree(std::move(given)), at(tree), start_(tree), path_end_(tree) {}
  Ik(const Ik&) = delete;

  // Move the hand towards its targets for one sample.
  void solve(const Goal& goal, const When& when, const Vector& margins, double speed,
             Result& result) {
    const Interval interval = motion.next(when);
    const double dt = interval.dt;
    at.place(motion.q.data());
    bounds(interval, speed);
    const int n = tree.size;
    bool has_rows = false;
    if (pairs) {
      start_.copy(at);
      pairs->rows(start_, dt, margins, motion.displacement, linear_);
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
    while (last_step > settings.step_tolerance && iterations < settings.max_iterations) {
      // Leave later iterations the rest of the bounds, which hold for the whole sample.
      for (int i = 0; i < n; ++i) {
        least_[i] = lower_[i] - total_[i];
        most_[i] = upper_[i] - total_[i];
      }
      if (has_rows)
        feasible_.loosen(linear_, least_, most_, limits.stopping(motion, dt), total_, h_);
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
    // Solve from the start again, and keep apart the points that met.
    const auto around = [&](bool by_margins) {
      double length2;
      pairs->add_met(start_, by_margins, linear_);
      total_.assign(n, 0.0);
      feasible_.loosen(linear_, lower_, upper_, limits.stopping(motion, dt), total_, h_);
      least_ = lower_;
      most_ = upper_;
      if (!has_first_cost) {
        at.copy(start_);
        cost(goal);
      }
      const bool has_step = minimise(linear_.count, length2, has_first_cost);
      has_first_cost = true;
      ++iterations;
      for (int i = 0; i < n; ++i)
        total_[i] = clip(has_step ? qp_.x[i] : 0.0, lower_[i], upper_[i]);
    };
    // See qp.PointIk.solve_once.
    for (int look = 0; has_rows && look < kLooks; ++look) {
      path_.resize(tree.nv);
      tree.expand(total_.data(), path_.data());
      if (!pairs->meets_at(start_, path_.data(), at)) break;
      around(true);
      first_ = total_;
      at.displace(motion.q.data(), total_.data());
    }
    has_stopped_ = false;
    admit(total_, first_, interval, [&] { around(false); });
    if (!has_stopped_) find_holding();
    at.place(motion.q.data());
    if (pairs) pairs->arrive(at, path_end_);
    finish(goal, iterations, last_step, has_failed, result);
  }

  // Take the stop that was admitted last, for one sample; see qp.PointIk.hold.
  void hold(const When& when, Result& result) {
    const Interval interval = motion.next(when);
    const double dt = interval.dt;
    stop_detours();
    braking(dt, taken_);
    times_.resize(tree.size);
    for (int i = 0; i < tree.size; ++i) times_[i] = std::max(motion.stop_times[i] - dt, 0.0);
    move(taken_, times_, interval);
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

  // Postures of the cost of a sample; see qp.PointIk.postures.
  std::vector<Posture> postures(const Vector& rest, double dt) const {
    std::vector<Posture> found{{settings.rest_weight, rest}};
    if (settings.speed_weight == 0.0 && settings.acceleration_weight == 0.0) return found;
    Vector start, ahead;
    for (size_t j = 0; j < tree.q_indices.size(); ++j) {
      start.push_back(motion.q[tree.q_indices[j]]);
      ahead.push_back(start[j] + dt * (motion.displacement[tree.joint_columns[j]] / motion.dt));
    }
    found.push_back({settings.speed_weight, start});
    found.push_back({settings.acceleration_weight, ahead});
    return found;
  }

  // Move by a displacement, or by another one that is admitted; see limits.Gate.admit. `around`
  // leaves another one in `total_`.
  template <class Around>
  void admit(const Vector& wanted, const Vector& first, const Interval& interval,
             const Around& around, int tries = kTries) {
    const int n = tree.size;
    const double dt = interval.dt;
    limits.box(motion, dt, box_);
    taken_.resize(n);
    bool is_inside = true;
    for (int i = 0; i < n; ++i) {
      taken_[i] = std::fmin(std::fmax(wanted[i], box_.lower[i]), box_.upper[i]);
      is_inside &= taken_[i] >= box_.least[i] && taken_[i] <= box_.most[i];
    }
    limits.stop_times(taken_, dt, times_);
    if (!(is_inside && is_clear(taken_, times_, dt))) {
      if (is_inside && tries > 0 && pairs->has_met()) {
        around();
        return admit(total_, total_, interval, around, tries - 1);
      }
      has_stopped_ = is_inside && pairs->has_met();
      if (has_stopped_) held_by_ = pairs->nearest_met();
      Vector short_first(n);
      for (int i = 0; i < n; ++i)
        short_first[i] = std::fmin(std::fmax(first[i], box_.lower[i]), box_.upper[i]);
      shorten(taken_, short_first, dt);
    }
    move(taken_, times_, interval);
  }

  Placed at;               // where the hand is
  std::int64_t costs = 0;  // number of costs that were computed, as a measure of work

 private:
  // See limits.Gate.bounds.
  void bounds(const Interval& interval, double share) {
    const auto [dt, granted, time] = interval;
    limits.box(motion, dt, box_);
    lower_.resize(tree.size);
    upper_.resize(tree.size);
    const double change = limits.change(granted);
    for (int i = 0; i < tree.size; ++i) {
      const double farthest = share * granted * limits.speeds[i];
      double least = -farthest, most = farthest;
      if (granted < dt) {
        // Without commands, the robot has braked in the time beyond the grant.
        const double beyond = (dt - granted) / std::max(motion.stop_times[i], 1e-300);
        const double velocity = motion.displacement[i] / motion.dt;
        const double middle = velocity * std::max(1.0 - beyond, 0.0) * granted;
        least = clip(least, middle - change, middle + change);
        most = clip(most, middle - change, middle + change);
      }
      lower_[i] = clip(least, box_.lower[i], box_.upper[i]);
      upper_[i] = clip(most, box_.lower[i], box_.upper[i]);
    }
  }

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

  // Note the pair whose row the cost presses the last step against most; see limits.Gate.press.
  void find_holding() {
    held_by_ = -1;
    if (!is_pressed_) return;
    const int n = tree.size;
    const Vector& slope = qp_.slope(kTight);
    int found = -1;
    double most = 0.0;
    for (int k = 0; k < linear_.count; ++k) {
      const double* g = linear_.G.data() + k * n;
      if (h_[k] - Qp::dot(g, qp_.x.data(), n) > kTight) continue;
      const double length2 = Qp::dot(g, g, n) + kLever * kLever;
      const double pressed = -Qp::dot(g, slope.data(), n) / length2;
      if (!(pressed > kPressing)) continue;
      const double rounded = std::nearbyint(1e3 * pressed);
      if (found >= 0 && !(rounded > most)) continue;
      most = rounded;
      found = k;
    }
    held_by_ = pairs->pair_of(found);
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

  void start_levers(int joint) {
    levers_.resize(tree.size);
    if (joint >= 0)
      for (const int i : tree.moving[joint]) levers_[i] = Vec3{};
  }

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

  const std::vector<int>& support(int joint) const {
    return joint < 0 ? none_ : tree.supports[joint];
  }
  const std::vector<int>& moving(int joint) const {
    return joint < 0 ? none_ : tree.moving[joint];
  }

  // c and the lower triangle of H of the QP where the hand is.
  void cost(const Goal& goal) {
    const int n = tree.size;
    ++costs;
    H_.assign(n * n, 0.0);
    c_.assign(n, 0.0);
    diagonal_.assign(n, weights.damping * weights.damping);
    for (size_t j = 0; j < goal.damping_shares.size(); ++j)
      diagonal_[tree.joint_columns[j]] *= goal.damping_shares[j] * goal.damping_shares[j];
    place_targets(goal);
    for (size_t i = 0; i < tree.parts.size(); ++i) {
      damp(add_points(tree.parts[i], is_carried(goal)));
      if (!goal.wrists.empty()) damp(add_wrist(tree.parts[i], goal.wrists[i]));
    }
    for (const Posture& posture : goal.postures) {
      for (size_t j = 0; j < tree.joint_columns.size(); ++j) {
        const int i = tree.joint_columns[j];
        const double weight = posture.weight * (posture.shares.empty() ? 1.0 : posture.shares[j]);
        const double weight2 = weight * weight;
        diagonal_[i] += weight2;
        c_[i] += weight2 * (at.q[tree.q_indices[j]] - posture.q[j]);
      }
    }
    for (const AimedDistances& aimed : goal.distances)
      add_distances(*aimed.task, aimed.aims, aimed.weights);
    for (const OffsetTask& offset : goal.offsets) add_offset(offset);
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

  // Whether the points' targets go with the wrists; see qp.carriers.
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
      for (const int c : support(attached.joint))
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
    for (const int c : support(joint)) {
      const Vec3 angular = tmul(here.R, at.columns[c].w);
      const Vec3 linear = tmul(here.R, at.velocity(c, here.p));
      levers_[tree.leader[c]] += (a * tree.factor[c]) * (log.A * linear + log.B * angular);
    }
    add_levers(joint, v);
    start_levers(joint);
    for (const int c : support(joint))
      levers_[tree.leader[c]] +=
          (b * tree.factor[c]) * (log.A * tmul(here.R, at.columns[c].w));
    add_levers(joint, w);
    return dot(v, v) + dot(w, w);
  }

  // Rows of distances: see tasks.PointDistances.
  void add_distances(const DistanceTask& task, const Vector& aims, const Vector& aim_weights) {
    constexpr double kShortest = 1e-9;
    const int n = tree.size;
    block_.resize(4 * n);
    turns_.resize(n);
    for (size_t k = 0; k < task.first.size(); ++k) {
      const double weight = aim_weights[k] / kLengthUnit;
      if (weight == 0.0) continue;
      const Attached &a = task.points[task.first[k]], &b = task.points[task.second[k]];
      const Vec3 from = at.point(b), to = at.point(a);
      Vec3 offset = to - from;
      const double apart = std::max(norm(offset), kShortest);
      // Points in one place have no direction: any will do to part them.
      if (apart == kShortest) offset = {0.0, 0.0, kShortest};
      const Vec3 direction = (1.0 / apart) * offset;
      const std::vector<int>&moving_a = moving(a.joint), &moving_b = moving(b.joint);
      start_levers(a.joint);
      start_levers(b.joint);
      for (const int i : moving_a) turns_[i] = Vec3{};
      for (const int i : moving_b) turns_[i] = Vec3{};
      // What moves both, such as a wrist, leaves their distance.
      const std::vector<int>&support_a = support(a.joint), &support_b = support(b.joint);
      auto [own_a, own_b] = std::mismatch(support_a.begin(), support_a.end(), support_b.begin(),
                                          support_b.end());
      const auto add = [&](int c, double sign, const Vec3& point) {
        levers_[tree.leader[c]] += sign * tree.factor[c] * at.velocity(c, point);
        turns_[tree.leader[c]] += tree.factor[c] * at.columns[c].w;
      };
      for (; own_a != support_a.end(); ++own_a) add(*own_a, 1.0, to);
      for (; own_b != support_b.end(); ++own_b) add(*own_b, -1.0, from);
      movers_.clear();
      std::set_union(moving_a.begin(), moving_a.end(), moving_b.begin(), moving_b.end(),
                     std::back_inserter(movers_));
      const double residual = weight * (apart - aims[k]), errors[4] = {residual, 0.0, 0.0, 0.0};
      const double pull = std::sqrt(std::max(weight * residual / apart, 0.0));
      columns_.clear();
      for (const int i : movers_) {
        const Vec3 lever = levers_[i];
        if (norm(lever) == 0.0) continue;
        columns_.push_back(i);
        const double slope = dot(direction, lever);
        block_[i] = weight * slope;
        // The second derivatives: of the offset's length, and of the offset along itself.
        const Vec3 across = pull * (lever - slope * direction);
        block_[n + i] = across.x;
        block_[2 * n + i] = across.y;
        block_[3 * n + i] = across.z;
        const double bend = dot(direction, cross(turns_[i], lever));
        diagonal_[i] += std::max(weight * residual * bend, 0.0);
      }
      add_rows(block_.data(), pull > 0.0 ? 4 : 1, errors);
    }
  }

  // Rows of one point's offset from another: see tasks.PointOffset.
  void add_offset(const OffsetTask& task) {
    const int n = tree.size;
    const Vec3 from = at.point(task.from), to = at.point(task.to);
    const Vec3 error = task.weight * (to - from - task.aim);
    const std::vector<int>&moving_a = moving(task.to.joint), &moving_b = moving(task.from.joint);
    start_levers(task.to.joint);
    start_levers(task.from.joint);
    for (const int c : support(task.to.joint))
      levers_[tree.leader[c]] += (task.weight * tree.factor[c]) * at.velocity(c, to);
    for (const int c : support(task.from.joint))
      levers_[tree.leader[c]] += (-task.weight * tree.factor[c]) * at.velocity(c, from);
    columns_.clear();
    std::set_union(moving_a.begin(), moving_a.end(), moving_b.begin(), moving_b.end(),
                   std::back_inserter(columns_));
    block_.resize(4 * n);
    for (const int i : columns_)
      for (int axis = 0; axis < 3; ++axis) block_[axis * n + i] = levers_[i][axis];
    const double errors[3] = {error.x, error.y, error.z};
    add_rows(block_.data(), 3, errors);
  }

  // Whether a displacement and the stop behind it are clear of overlaps.
  bool is_clear(const Vector& displacement, const Vector& times, double dt) {
    if (!pairs) return true;
    double time = 0.0;
    for (int i = 0; i < tree.size; ++i)
      if (limits.together[i]) time = std::max(time, times[i]);
    whole_.resize(tree.size);
    for (int i = 0; i < tree.size; ++i)
      whole_[i] = limits.together[i] ? (1.0 + 0.5 * time / dt) * displacement[i] : 0.0;
    start_.place(motion.q.data());
    path_end_.displace(motion.q.data(), whole_.data(), &at);
    path_.resize(tree.nv);
    tree.expand(whole_.data(), path_.data());
    return pairs->is_clear(start_, path_.data(), path_end_);
  }

  void braking(double dt, Vector& displacement) const {
    displacement.resize(tree.size);
    for (int i = 0; i < tree.size; ++i) {
      const double share = 1.0 - dt / std::max(motion.stop_times[i], dt);
      displacement[i] = motion.displacement[i] / motion.dt * (dt * share);
    }
  }

  // Find a displacement that is admitted, and the times of the stop behind it; see Gate._shortened.
  void shorten(const Vector& wanted, const Vector& first, double dt) {
    const int n = tree.size;
    Vector brake, left(n), least(n), most(n), clipped(n), base(n), tried(n), times(n), taken(n);
    braking(dt, brake);
    const double change = limits.change(dt);
    for (int i = 0; i < n; ++i) {
      const double middle = motion.displacement[i] / motion.dt * dt;
      left[i] = std::max(motion.stop_times[i] - dt, 0.0);
      // From a higher limit, the stop in force may brake harder than the limit allows.
      least[i] = std::min(middle - change, brake[i]);
      most[i] = std::max(middle + change, brake[i]);
      clipped[i] = clip(first[i], least[i], most[i]);
      base[i] = limits.together[i] ? brake[i] : clipped[i];
    }
    std::vector<std::vector<int>> parts;
    for (const Vector& is_finger : fingers) {
      parts.emplace_back();
      for (size_t j = 0; j < is_finger.size(); ++j)
        if (is_finger[j] != 0.0) parts.back().push_back(tree.joint_columns[j]);
    }
    parts.emplace_back(n);
    std::iota(parts.back().begin(), parts.back().end(), 0);
    for (const std::vector<int>& own : parts) {
      for (int i = 0; i < n; ++i) tried[i] = clip(wanted[i], least[i], most[i]);
      std::vector<Vector> candidates{tried};
      for (const double share : kShares) {
        for (int i = 0; i < n; ++i) tried[i] = base[i] + share * (clipped[i] - base[i]);
        candidates.push_back(tried);
      }
      candidates.push_back(base);
      bool is_admitted = false;
      for (size_t c = 0; c < candidates.size() && !is_admitted; ++c) {
        tried = base;
        for (const int i : own) tried[i] = candidates[c][i];
        limits.stop_times(tried, dt, times);
        bool can_all = true;
        for (int i = 0; i < n; ++i) {
          const bool can_stop =
              limits.is_inside(i, motion.q, tried[i] * (1.0 + 0.5 * times[i] / dt)) &&
              times[i] <= kLongestStop * (1.0 + 1e-9);
          const bool brakes = !can_stop && !limits.together[i];
          taken[i] = brakes ? brake[i] : tried[i];
          if (brakes) times[i] = left[i];
          if (limits.together[i]) can_all &= can_stop;
        }
        is_admitted = can_all && is_clear(taken, times, dt);
      }
      // The line of the stop in force was found clear before.
      for (int i = 0; i < n && !is_admitted; ++i)
        if (limits.together[i]) times[i] = left[i];
      for (const int i : own) clipped[i] = taken[i];
    }
    taken_ = taken;
    times_ = times;
  }

  void move(const Vector& displacement, const Vector& times, const Interval& interval) {
    Vector &step = path_, &reached = reached_;
    step.resize(tree.nv);
    reached.resize(tree.nq);
    tree.expand(displacement.data(), step.data());
    tree.integrate(motion.q.data(), step.data(), reached.data());
    for (int i = 0; i < tree.nq; ++i) {
      const double before = motion.q[i];
      reached[i] = clip(reached[i], std::min(limits.lowest[i], before),
                        std::max(limits.highest[i], before));
    }
    motion.q = reached;
    motion.displacement = displacement;
    motion.dt = interval.dt;
    motion.time = interval.time;
    motion.stop_times = times;
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
    result.held_by = held_by_;
    result.status = has_failed                                              ? Status::failed
                    : std::sqrt(farthest2) <= settings.point_tolerance ? Status::converged
                    : at_bound                                              ? Status::limited
                    : last_step <= kAtRest                                  ? Status::unreachable
                                                                            : Status::unsettled;
  }

  GuessedQp qp_;
  Feasible feasible_;
  Rows linear_;
  Box box_;
  TaskRows further_;
  Placed start_, path_end_;
  // Whether a row is active in the last step, and whether pairs that met stopped the hand.
  bool is_pressed_ = false, has_stopped_ = false;
  int held_by_ = -1;  // the pair that holds the hand back
  const std::vector<int> none_;
  std::vector<int> columns_, movers_;
  std::vector<signed char> guess_;
  std::vector<Vec3> levers_, turns_, targets_;
  Vector levers2_, lower_, upper_, expected_, total_, first_, least_, most_, h_, H_, c_, diagonal_, block_,
      taken_, times_, path_, whole_, reached_;
};

}  // namespace handmap
