// Limits of a displacement: a box that is never empty.
//
// The box of position, speed and acceleration limits is
//
//     clip(q_min - q, -v dt, v dt) <= dq <= clip(q_max - q, -v dt, v dt).
//
// Clipping is monotone, so the lower bound never passes the upper one, also where `q` starts outside its
// limits: there both bounds meet at the speed limit and the joint comes back as fast as it may. The
// stacked position and speed rows of mink and pink are infeasible in that case.
//
// An acceleration limit is clipped into that box the same way, `clip(v_last dt -+ a dt^2, lower, upper)`:
// position and speed limits have priority. To avoid such conflicts, a joint approaches its limit only as
// fast as it can still brake,
//
//     v dt + v^2 / (2 a) <= distance to the limit.
//
// Once true, this stays true from command to command for any times. So a joint that starts at rest inside
// its limits keeps both limits. No coordinate moves faster than `a kLongestStop`, so every stop takes at
// most that time, whatever the limit is.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <limits>

#include "model_reader.hpp"

namespace handmap {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
// Least time that a command accounts for [s]. In less, rounding of positions would be a speed.
constexpr double kShortestDt = 1e-6;
// Longest time in which a robot stops: hand.LONGEST_STOP [s].
constexpr double kLongestStop = 0.5;
// A stop that ends outside the limits by no more counts as inside [rad or m].
constexpr double kRounding = 1e-12;
// Distances count as no more than this, because a floating wrist has infinite ones [rad or m].
constexpr double kFar = 1e9;
// Pairs that are nearer than their margin by less than this need not part [m].
constexpr double kRoughly = 2e-5;
// Share of their excess by which pairs part in a sample. All of it makes links oscillate that are
// pressed together.
constexpr double kParted = 0.3;
// Pairs whose distance changes by less than this part slowly [m/rad]: all of the box would part them by
// a few um, and the fingers would jump.
constexpr double kLever = 0.015;
// Parting takes this share of the box at most. All of it may leave nothing but its corner.
constexpr double kInside = 0.9;
// A row is tight within this [m]. It holds a step back where the cost would fall by this much per metre:
// where a point stays some millimetre from its target because of it.
constexpr double kTight = 1e-7;
constexpr double kPressing = 10.0;
// How often a way is sought around what meets, and how often a step is solved again with the points that
// come too near where it ends.
constexpr int kTries = 3;
constexpr int kLooks = 3;
// Rows for which there is room from the beginning: hands with 1,800 pairs of shapes have a hundred at once.
// The first sample with more takes memory.
constexpr size_t kUsualRows = 256;
// Shares of a displacement that are tried where all of it is not admitted.
constexpr double kShares[] = {1.0, 0.5, 0.25, 0.1};

inline double clip(double value, double least, double most) {
  return std::min(std::max(value, least), most);
}

// When a command is: an instant on the robot's clock, or a time since its last command.
struct When {
  bool is_instant = false;
  double time = 0.0;           // the instant, or the time since the last command [s]
  double longest = kInfinity;  // longest time that the command may take [s]

  // See command_time.own_time.
  double own_time() const { return is_instant ? longest : time; }

  static When after(double dt) { return {false, dt, kInfinity}; }
  static When at(double time, double longest) { return {true, time, longest}; }
};

// The time of a robot's next command.
struct Interval {
  double dt;       // since the robot's last command [s]
  double granted;  // the part of it in which the command may move the robot [s]
  double time;     // instant of the command on the robot's clock [s]
};

// How a robot moves.
struct Motion {
  Vector q;             // configuration last commanded, (nq,)
  Vector displacement;  // of the last command, in the active coordinates
  double dt = 1.0;      // time from the command before to the last one [s]
  Vector stop_times;    // in which each coordinate can stop on the line that was admitted [s]
  double time = 0.0;    // instant of the last command, on the robot's clock [s]
  std::uint64_t stamp = 0;  // no two commands of a process have the same
  std::int64_t commands = 0;  // how many the robot has had

  // Make room for the motion of a robot.
  void reserve(size_t configuration, size_t coordinates) {
    q.reserve(configuration);
    for (Vector* each : {&displacement, &stop_times}) each->reserve(coordinates);
  }

  // The time of the next command; `kShortestDt` if it is not later than the last.
  Interval next(const When& when) const {
    // `max` keeps its first argument where the other one is NaN.
    if (!when.is_instant) {
      const double dt = std::max(kShortestDt, when.time);
      return {dt, dt, time + dt};
    }
    const double since = std::max(kShortestDt, when.time - time);
    return {since, std::min(since, std::max(kShortestDt, when.longest)),
            std::max(time + kShortestDt, when.time)};
  }
};

// A stamp that no other motion of this process has.
inline std::uint64_t new_stamp() {
  static std::atomic<std::uint64_t> last{0};
  return ++last;
}

// Bounds of a displacement; then the least and the largest one to which the acceleration limit leads, with
// a stop behind it inside the limits of position and time.
struct Box {
  Vector lower, upper, least, most;
};

// A model; see handmap_core/models/limits.py.
class BoxLimits {
 public:
  static constexpr const char* kName = "BoxLimits";
  Vector lowest, highest;        // of a configuration, (nq,)
  Vector lower, upper, speeds;   // of the active coordinates
  std::vector<int> coordinates;  // index of each in a configuration
  std::vector<char> together;
  double acceleration = kInfinity;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("lowest", lowest);
    visit("highest", highest);
    visit("lower", lower);
    visit("upper", upper);
    visit("speeds", speeds);
    visit("coordinates", coordinates);
    visit("together", together);
    visit("acceleration", acceleration);
  }
  void check() const {
    expect_count("BoxLimits.highest", highest.size(), lowest.size());
    for (const size_t count :
         {upper.size(), speeds.size(), coordinates.size(), together.size()})
      expect_count("BoxLimits: upper, speeds, coordinates, together", count, lower.size());
    expect_below("BoxLimits.coordinates", coordinates, lowest.size());
  }
  // Number of coordinates.
  int size() const { return static_cast<int>(lower.size()); }

  bool any_together() const {
    return std::find(together.begin(), together.end(), 1) != together.end();
  }

  void box(const Motion& motion, double dt, Box& box) const {
    for (Vector* part : {&box.lower, &box.upper, &box.least, &box.most}) part->resize(size());
    const double change = this->change(dt), usable = acceleration * (kLongestStop * dt);
    const double stretch = 1.0 + stopping(motion, dt), slack = kRounding * dt;
    for (int i = 0; i < size(); ++i) {
      const double here = motion.q[coordinates[i]], farthest = speeds[i] * dt;
      const double down = lower[i] - here, up = upper[i] - here;
      const double low = clip(down, -farthest, farthest), high = clip(up, -farthest, farthest);
      if (acceleration == kInfinity) {
        box.lower[i] = box.least[i] = low;
        box.upper[i] = box.most[i] = high;
        continue;
      }
      // Past a limit there is no braking distance left; the box brings the joint back.
      auto admissible = [&](double room) {
        const double distance = clip(room, 0.0, kFar);
        const double most = std::min(braking_displacement(distance, change), usable);
        return together[i] ? std::min(most, distance / stretch) : most;
      };
      const double middle = motion.displacement[i] / motion.dt * dt;
      const double least = -admissible(-down), most = admissible(up);
      const double lowest_now = middle - change, highest_now = middle + change;
      box.lower[i] = clip(clip(least, lowest_now, highest_now), low, high);
      box.upper[i] = clip(clip(most, lowest_now, highest_now), low, high);
      box.least[i] = std::max(least, lowest_now) - slack;
      box.most[i] = std::min(most, highest_now) + slack;
    }
  }

  bool is_inside(int i, const Vector& q, double displacement) const {
    const double here = q[coordinates[i]];
    return displacement >= std::min(lower[i] - kRounding - here, 0.0) &&
           displacement <= std::max(upper[i] + kRounding - here, 0.0);
  }

  // A coordinate of a configuration inside its limits, or no farther outside than before.
  double clipped(int i, double q, double before) const {
    return clip(q, std::min(lowest[i], before), std::max(highest[i], before));
  }

  // By how much acceleration can change a displacement; never 0.
  double change(double dt) const { return std::max(acceleration * (dt * dt), 1e-200); }

  void stop_times(const Vector& displacement, double dt, Vector& times) const {
    times.assign(size(), 0.0);
    if (acceleration == kInfinity) return;
    double longest = 0.0;
    for (int i = 0; i < size(); ++i) {
      times[i] = std::abs(displacement[i] / dt) / acceleration;
      if (together[i]) longest = std::max(longest, times[i]);
    }
    for (int i = 0; i < size(); ++i)
      if (together[i]) times[i] = longest;
  }

  // A bound of the stop behind the next displacement, as a multiple of it.
  double stopping(const Motion& motion, double dt) const {
    if (acceleration == kInfinity || !any_together()) return 0.0;
    double fastest = 0.0;
    for (int i = 0; i < size(); ++i)
      if (together[i]) fastest = std::max(fastest, std::abs(motion.displacement[i] / motion.dt));
    return 0.5 * (fastest / acceleration + dt) / dt;
  }

  static double braking_displacement(double distance, double change) {
    return 2.0 * distance / (1.0 + std::sqrt(1.0 + 2.0 * distance / change));
  }
};

// Rows G x <= h.
struct Rows {
  int count = 0;
  Vector G, h;

  // Make room for rows of so many coordinates.
  void reserve(size_t coordinates, size_t rows) {
    G.reserve(coordinates * rows);
    h.reserve(rows);
  }
};

// Loosens rows where they contradict each other or a box.
//
// The displacement nearest to none inside the box always satisfies them: where a pair is nearer than the
// margin already, it need not part at once, only not come closer than the limits make it. Where a
// displacement is found that parts all those pairs without harm to the others, that is what they are held
// to; it is damped, so that pairs whose distance hardly depends on the joints part slowly.
class Feasible {
 public:
  // Make room for rows of so many coordinates.
  void reserve(size_t coordinates, size_t rows) {
    for (Vector* each : {&witness_, &within_}) each->reserve(coordinates);
    for (Vector* each : {&kept_, &excess_, &parted_, &share_}) each->reserve(rows);
    near_.reserve(rows);
    // Pairs that are too near already are few.
    gram_.reserve(kMostTooNear * kMostTooNear);
  }

  void loosen(const Rows& rows, const Vector& lower, const Vector& upper, double stopping,
              const Vector& so_far, Vector& h) {
    const int n = static_cast<int>(lower.size()), r = rows.count;
    h.resize(r);
    kept_.assign(r, 0.0);
    witness_.resize(n);
    for (int i = 0; i < n; ++i) witness_[i] = clip(0.0, lower[i], upper[i]);
    near_.clear();
    excess_.resize(r);
    for (int k = 0; k < r; ++k) {
      const double* g = rows.G.data() + k * n;
      double before = 0.0;
      for (int i = 0; i < n; ++i) {
        before += g[i] * so_far[i];
        kept_[k] += g[i] * witness_[i];
      }
      h[k] = rows.h[k] / (1.0 + stopping) - before;
      excess_[k] = kept_[k] - h[k];
      if (excess_[k] > kRoughly) near_.push_back(k);
    }
    if (near_.empty()) {
      for (int k = 0; k < r; ++k) h[k] = std::max(h[k], kept_[k]);
      return;
    }
    part(rows, lower, upper);
    bool does_harm = false;
    parted_.assign(r, 0.0);
    for (int k = 0; k < r; ++k) {
      const double* g = rows.G.data() + k * n;
      for (int i = 0; i < n; ++i) parted_[k] += g[i] * within_[i];
      parted_[k] += kept_[k];
      does_harm |= !(excess_[k] > kRoughly) && parted_[k] > std::max(h[k], kept_[k]) + kRounding;
    }
    for (int k = 0; k < r; ++k) h[k] = std::max(h[k], does_harm ? kept_[k] : parted_[k]);
  }

 private:
  // The damped displacement that parts all pairs that are too near, inside the box.
  void part(const Rows& rows, const Vector& lower, const Vector& upper) {
    const int n = static_cast<int>(lower.size()), m = static_cast<int>(near_.size());
    gram_.resize(m * m);
    share_.resize(m);
    for (int a = 0; a < m; ++a) {
      const double* g = rows.G.data() + near_[a] * n;
      for (int b = 0; b <= a; ++b) {
        const double* o = rows.G.data() + near_[b] * n;
        double sum = a == b ? kLever * kLever : 0.0;
        for (int i = 0; i < n; ++i) sum += g[i] * o[i];
        for (int k = 0; k < b; ++k) sum -= gram_[a * m + k] * gram_[b * m + k];
        gram_[a * m + b] = a == b ? std::sqrt(sum) : sum / gram_[b * m + b];
      }
    }
    for (int a = 0; a < m; ++a) {
      double sum = excess_[near_[a]];
      for (int k = 0; k < a; ++k) sum -= gram_[a * m + k] * share_[k];
      share_[a] = sum / gram_[a * m + a];
    }
    for (int a = m - 1; a >= 0; --a) {
      double sum = share_[a];
      for (int k = a + 1; k < m; ++k) sum -= gram_[k * m + a] * share_[k];
      share_[a] = sum / gram_[a * m + a];
    }
    within_.assign(n, 0.0);
    for (int a = 0; a < m; ++a) {
      const double* g = rows.G.data() + near_[a] * n;
      for (int i = 0; i < n; ++i) within_[i] -= kParted * share_[a] * g[i];
    }
    for (int i = 0; i < n; ++i)
      within_[i] = clip(within_[i], kInside * (lower[i] - witness_[i]),
                        kInside * (upper[i] - witness_[i]));
  }

  static constexpr size_t kMostTooNear = 64;

  Vector witness_, kept_, excess_, parted_, within_, gram_, share_;
  std::vector<int> near_;
};

}  // namespace handmap
