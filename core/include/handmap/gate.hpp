// The gate: it owns the motion of a robot and its time, and every displacement passes it.
//
// It keeps a stop behind every displacement possible. A displacement x takes a command of dt. Behind it
// each coordinate can brake in a time T, and moves by half of T times its velocity meanwhile. So the
// command and the stop are the line from q to
//
//     q + (1 + T / (2 dt)) x
//
// together. Coordinates that move shapes against each other brake together, each in proportion to its
// speed, with the T of the slowest, so that the hand stays on the straight line that it moves on. A
// displacement is admitted if
//
// - it is within the limits of position, speed and acceleration (limits.hpp),
// - the whole line is inside the position limits and, where links are kept apart, clear of overlaps,
// - T is at most `kLongestStop`.
//
// The stop that was admitted last stays possible while the hand brakes, for any times of commands:
//
//     x_brake = v (1 - dt / T) dt,    v the last velocity,
//
// ends on the line that was found clear, and needs the time T - dt. Another displacement that is not
// admitted is shortened towards x_brake, the fingers of each hand by themselves, and replaced by it at
// last. Both are within the limits of speed and acceleration, so all between are. A hand that starts
// without an overlap never has one.
//
// Where a limit is lowered while the hand moves, the stop that was found under the former one stays in
// force until a stop under the new one is admitted.
//
// **It owns the time.** It knows the instant of the robot's last command. The next command gives its own
// instant, and takes the time between both, whoever asked for the last one: dt above is that time. A
// command that is not later takes `kShortestDt`. So the speed x / dt and the acceleration
// (x / dt - v) / dt, v the velocity of the command before, hold by the time stamps of the commands.
//
// A command after a pause must not make up for all of it. It moves as far as the time that is granted
// allows, and counts as braking without commands in the time beyond that. If braking over the whole time
// leads farther, the acceleration limit has priority.
#pragma once

#include <cstdint>
#include <iterator>
#include <memory>
#include <numeric>
#include <utility>

#include "busy.hpp"
#include "limits.hpp"
#include "pairs.hpp"
#include "qp.hpp"

namespace handmap {

// Distances that proofs may measure in a sample, for each hand of the robot: those of what is wanted, and
// of ways around what meets; those of what is shortened; and those of a tenth of it, where the ones before
// did not suffice.
constexpr std::int64_t kProofs = 700, kShortProofs = 500, kLastProof = 60;

class Gate : public Exclusive {
 public:
  Tree tree;
  BoxLimits limits;
  std::unique_ptr<Pairs> pairs;  // of shapes to keep apart; null for none
  Motion motion;
  int held_by = -1;  // the pair of shapes that held the last displacement back; -1 for none
  Placed at;         // where the robot was looked at last: where it is, or where a displacement leads

  explicit Gate(Tree given)
      : tree(std::move(given)), at(tree), start(tree), path_end(tree), moving_(moving_parts(tree)) {}
  Gate(const Gate&) = delete;
  virtual ~Gate() = default;

  // Take over a motion, such as that of another gate of this robot.
  void set_motion(const Motion& taken) {
    motion = taken;
    was_moved();
  }

  // Something else than the QPs of an `Ik` moves the robot.
  virtual void was_moved() {}

  // Move by a displacement, or by another one that is admitted. `first` is shortened if the wanted one
  // is not admitted. `around` finds one that takes the place of both, and keeps apart what meets on the
  // line of the wanted one; it is asked `tries` times at most.
  template <class Around>
  void admit(const Vector& wanted, const Vector& first, const Interval& interval,
             const Around& around, int tries) {
    grant(kProofs);
    admit_granted(wanted, first, interval, around, tries);
  }
  void admit(const Vector& wanted, const Vector& first, const Interval& interval) {
    was_moved();
    admit(wanted, first, interval, [&]() -> const Vector& { return wanted; }, 0);
  }

  // Take the stop that was admitted last, for one command.
  void brake(const When& when) {
    const Interval interval = motion.next(when);
    was_moved();
    held_by = -1;
    braking(interval.dt, taken_);
    times_.resize(tree.size);
    for (int i = 0; i < tree.size; ++i)
      times_[i] = std::max(motion.stop_times[i] - interval.dt, 0.0);
    move(taken_, times_, interval);
  }

  // Bounds of the next displacement, with a share of the speed limits as far as braking allows.
  void bounds(const Interval& interval, double share, Vector& lower, Vector& upper) {
    const auto [dt, granted, time] = interval;
    limits.box(motion, dt, box_);
    lower.resize(tree.size);
    upper.resize(tree.size);
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
      lower[i] = clip(least, box_.lower[i], box_.upper[i]);
      upper[i] = clip(most, box_.lower[i], box_.upper[i]);
    }
  }

  // Move towards a configuration as far as is admitted. Where links are kept apart, the robot takes the
  // displacement nearest to the wanted one that their rows allow, so that links slide along each other
  // instead of meeting, or a part of it, or it brakes. With `stops`, it must be able to stop there at
  // once. Return whether the configuration is reached; it brakes where that is not finite.
  bool advance(const Vector& goal, const When& when, double share, bool stops) {
    const int n = tree.size;
    const Interval interval = motion.next(when);
    const Vector before = motion.q, change = change_to(goal);
    for (const double way : change)
      if (!std::isfinite(way)) {
        brake(when);
        return false;
      }
    const double braking = limits.change(interval.granted), reach = stops ? braking : kInfinity;
    Vector lower, upper, allowed(n), nearest(n), slack(n);
    bounds(interval, share, lower, upper);
    double free_share = 1.0;
    for (int i = 0; i < n; ++i) {
      const double farthest = limits.speeds[i] * (interval.granted * share);
      slack[i] = 1e-12 + 1e-9 * std::min(farthest, 1.0);
      // The part of the way that the robot takes if it must stop at its end.
      allowed[i] = BoxLimits::braking_displacement(std::abs(change[i]), braking);
      if (tree.is_floating && i < 6)
        free_share = std::min(free_share, farthest / std::max(allowed[i], 1e-300));
    }
    // Scale all six coordinates of a free wrist alike, so that it stays on its path.
    for (int i = 0; tree.is_floating && i < 6; ++i) allowed[i] *= free_share;
    bool is_there = true;
    for (int i = 0; i < n; ++i) {
      const double near = clip(clip(change[i], -reach, reach), lower[i], upper[i]);
      is_there &= std::abs(change[i] - near) <= slack[i];
      nearest[i] = clip(std::copysign(allowed[i], change[i]), lower[i], upper[i]);
    }
    const Vector wanted = is_there ? change : nearest;
    if (pairs) nearest = along_links(wanted, interval, lower, upper);
    admit(wanted, nearest, interval);
    for (int i = 0; i < n && is_there; ++i)
      is_there = std::abs(motion.displacement[i] - change[i]) <= slack[i];
    if (is_there)
      for (int i = 0; i < tree.nq; ++i) motion.q[i] = limits.clipped(i, goal[i], before[i]);
    return is_there;
  }

  // Rows G x <= h of the next displacement of a robot that keeps shapes apart, behind a part of it. `h` is
  // what the rows are loosened to where they contradict its bounds. Without margins, pairs keep the
  // hand's own.
  void rows(const Interval& interval, const Vector& margins, const Vector& lower, const Vector& upper,
            const Vector& so_far, Rows& rows, Vector& h) {
    start.place(motion.q.data());
    pairs->rows(start, interval.dt, margins, motion.displacement, rows);
    loosen(rows, interval, lower, upper, so_far, h);
  }

  // Loosen rows of the next displacement again: more of them, or behind another part of it.
  void loosen(const Rows& rows, const Interval& interval, const Vector& lower, const Vector& upper,
              const Vector& so_far, Vector& h) {
    feasible_.loosen(rows, lower, upper, limits.stopping(motion, interval.dt), so_far, h);
  }

  // Add rows of what met on the line of the displacement that was looked at last.
  void add_rows_on_line(Rows& rows) {
    start.place(motion.q.data());
    pairs->add_met(start, false, rows);
  }

  // Add rows of the points that the end of a displacement brings nearer, and within their margin. A row
  // knows one pair of points, and a link that lies flat on another one touches it next wherever it turns
  // to. Return whether there are any.
  bool add_rows_at_end(const Vector& displacement, Rows& rows) {
    path_.resize(tree.nv);
    tree.expand(displacement.data(), path_.data());
    at.displace(motion.q.data(), displacement.data());
    if (!pairs->meets_at(start, path_.data(), at)) return false;
    pairs->add_met(start, true, rows);
    return true;
  }

  // The pair whose row the cost presses a step against most, if it is much; -1 for none. The rows are the
  // last ones of the robot; `slope` is the derivative of the cost at the step, 0 at bounds of the box. Of
  // shapes in one plane, which press alike but for rounding, it is the first one.
  int pressed_pair(const Rows& rows, const Vector& h, const Vector& slope, const Vector& step) const {
    const int n = tree.size;
    int found = -1;
    double most = 0.0;
    for (int k = 0; k < rows.count; ++k) {
      const double* g = rows.G.data() + k * n;
      if (h[k] - Qp::dot(g, step.data(), n) > kTight) continue;
      const double length2 = Qp::dot(g, g, n) + kLever * kLever;
      const double pressed = -Qp::dot(g, slope.data(), n) / length2;
      if (!(pressed > kPressing)) continue;
      const double rounded = std::nearbyint(1e3 * pressed);
      if (found >= 0 && !(rounded > most)) continue;
      most = rounded;
      found = k;
    }
    return found < 0 ? -1 : pairs->pair_of(found);
  }

 protected:
  Placed start, path_end;  // where the line that was looked at last begins and ends

  // Move by a displacement that nothing has admitted.
  void move_unproved(const Vector& displacement, const Interval& interval) {
    times_.resize(tree.size);
    limits.stop_times(displacement, interval.dt, times_);
    move(displacement, times_, interval);
  }

  // Make room for what a sample needs at most, or usually where that is much more.
  void reserve_gate() {
    const size_t n = static_cast<size_t>(tree.size), nv = static_cast<size_t>(tree.nv);
    auto& [brake, left, least, most, clipped, base, tried, times, taken] = shortening_;
    for (Vector* each : {&brake, &left, &least, &most, &clipped, &base, &tried, &times, &taken,
                         &taken_, &short_first_, &times_, &whole_})
      each->reserve(n);
    path_.reserve(nv);
    if (!pairs) return;
    pairs->reserve();
    feasible_.reserve(n, kUsualRows);
  }

  Feasible feasible_;

 private:
  // The pose of a floating wrist, which has the first coordinates.
  static Pose free_pose(const Vector& q) {
    return {rotation_of({q[3], q[4], q[5], q[6]}), {q[0], q[1], q[2]}};
  }

  // The displacement from where the robot is to a configuration.
  Vector change_to(const Vector& goal) const {
    Vector change(tree.size);
    for (int i = 0; i < tree.size; ++i)
      change[i] = goal[limits.coordinates[i]] - motion.q[limits.coordinates[i]];
    if (tree.is_floating) {
      const Twist twist = log6(inverse(free_pose(motion.q)) * free_pose(goal));
      for (int i = 0; i < 3; ++i) {
        change[i] = twist.v[i];
        change[3 + i] = twist.w[i];
      }
    }
    return change;
  }

  // The displacement nearest to a wanted one that the rows of the pairs allow:
  //
  //     min |x - wanted|^2   s.t.   lower <= x <= upper,   G x <= h.
  Vector along_links(const Vector& wanted, const Interval& interval, const Vector& lower,
                     const Vector& upper) {
    // In units of this [rad or m], displacements are near one, where the solver works best.
    constexpr double kUnit = 0.05;
    const int n = tree.size;
    const Vector none(n, 0.0);
    Rows near;
    Vector h;
    rows(interval, {}, lower, upper, none, near, h);
    bool is_allowed = true;
    for (int k = 0; k < near.count; ++k)
      is_allowed &= Qp::dot(near.G.data() + k * n, wanted.data(), n) <= h[k];
    if (is_allowed) return wanted;
    Vector H(n * n, 0.0), c(n), least(n), most(n), found(n);
    for (int i = 0; i < n; ++i) {
      H[i * n + i] = 1.0;
      c[i] = -wanted[i] / kUnit;
      least[i] = lower[i] / kUnit;
      most[i] = upper[i] / kUnit;
    }
    for (double& each : h) each /= kUnit;
    // Without a solution, only the brake is left.
    const bool has_found = qp_.solve(n, H.data(), c.data(), least.data(), most.data(), near.count,
                                     near.G.data(), h.data());
    for (int i = 0; i < n; ++i)
      found[i] = clip(has_found ? qp_.x[i] * kUnit : 0.0, lower[i], upper[i]);
    return found;
  }

  // Likewise, with the distances that are granted already.
  template <class Around>
  void admit_granted(const Vector& wanted, const Vector& first, const Interval& interval,
                     const Around& around, int tries) {
    const int n = tree.size;
    const double dt = interval.dt;
    held_by = -1;
    limits.box(motion, dt, box_);
    taken_.resize(n);
    bool is_inside = true;
    for (int i = 0; i < n; ++i) {
      taken_[i] = std::fmin(std::fmax(wanted[i], box_.lower[i]), box_.upper[i]);
      is_inside &= taken_[i] >= box_.least[i] && taken_[i] <= box_.most[i];
    }
    limits.stop_times(taken_, dt, times_);
    if (!(is_inside && is_clear(taken_, times_, dt))) {
      if (is_inside && tries > 0 && pairs->has_met() && !pairs->is_spent()) {
        const Vector& other = around();
        return admit_granted(other, other, interval, around, tries - 1);
      }
      if (is_inside && pairs->has_met()) held_by = pairs->nearest_met();
      short_first_.resize(n);
      for (int i = 0; i < n; ++i)
        short_first_[i] = std::fmin(std::fmax(first[i], box_.lower[i]), box_.upper[i]);
      shorten(taken_, short_first_, dt);
    }
    move(taken_, times_, interval);
  }

  // Let proofs measure so many distances for each hand.
  void grant(std::int64_t distances) {
    if (pairs) pairs->grant(distances * std::max<std::int64_t>(tree.parts.size(), 1));
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
    start.place(motion.q.data());
    path_end.displace(motion.q.data(), whole_.data(), &at);
    path_.resize(tree.nv);
    tree.expand(whole_.data(), path_.data());
    return pairs->is_clear(start, path_.data(), path_end);
  }

  void braking(double dt, Vector& displacement) const {
    displacement.resize(tree.size);
    for (int i = 0; i < tree.size; ++i) {
      const double share = 1.0 - dt / std::max(motion.stop_times[i], dt);
      displacement[i] = motion.displacement[i] / motion.dt * (dt * share);
    }
  }

  // What moves by itself where a displacement is shortened: the fingers of each hand, then all coordinates.
  static std::vector<std::vector<int>> moving_parts(const Tree& tree) {
    std::vector<std::vector<int>> parts;
    for (const Vector& is_finger : tree.fingers) {
      parts.emplace_back();
      for (size_t j = 0; j < is_finger.size(); ++j)
        if (is_finger[j] != 0.0) parts.back().push_back(tree.joint_columns[j]);
    }
    parts.emplace_back(tree.size);
    std::iota(parts.back().begin(), parts.back().end(), 0);
    return parts;
  }

  // Find a displacement that is admitted, and the times of the stop behind it.
  void shorten(const Vector& wanted, const Vector& first, double dt) {
    const int n = tree.size;
    auto& [brake, left, least, most, clipped, base, tried, times, taken] = shortening_;
    for (Vector* each : {&left, &least, &most, &clipped, &base, &tried, &times, &taken})
      each->resize(n);
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
    // All of what is wanted, shares of the first displacement, and none of it.
    constexpr size_t kCandidates = std::size(kShares) + 2;
    // C++17 has no captures of structured bindings.
    const auto candidate = [&, &least = least, &most = most, &clipped = clipped, &base = base](
                               size_t c, int i) {
      if (c == 0) return clip(wanted[i], least[i], most[i]);
      if (c + 1 == kCandidates) return base[i];
      return base[i] + kShares[c - 1] * (clipped[i] - base[i]);
    };
    grant(kShortProofs);
    for (const std::vector<int>& own : moving_) {
      const bool is_last = &own == &moving_.back();
      bool is_admitted = false;
      for (size_t c = 0; c < kCandidates && !is_admitted; ++c) {
        // The smallest share is proved by a few distances.
        if (pairs && pairs->is_spent() && c + 1 < kCandidates) {
          if (is_last) grant(kLastProof);
          c = kCandidates - 2;
        }
        tried = base;
        for (const int i : own) tried[i] = candidate(c, i);
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
      // What could not be looked at by itself may still move with all others.
      const bool is_unknown =
          !is_admitted && !is_last && pairs && pairs->is_spent() && !pairs->has_met();
      for (const int i : own)
        if (!is_unknown) clipped[i] = taken[i];
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
    for (int i = 0; i < tree.nq; ++i)
      reached[i] = limits.clipped(i, reached[i], motion.q[i]);
    motion.q = reached;
    motion.displacement = displacement;
    motion.dt = interval.dt;
    motion.time = interval.time;
    motion.stop_times = times;
    motion.stamp = new_stamp();
    ++motion.commands;
  }

  // Memory in which `shorten` works.
  struct Shortening {
    Vector brake, left, least, most, clipped, base, tried, times, taken;
  };

  const std::vector<std::vector<int>> moving_;  // see `moving_parts`
  Box box_;
  Qp qp_;
  Shortening shortening_;
  Vector taken_, short_first_, times_, path_, whole_, reached_;
};

}  // namespace handmap
