// Smoothing of samples by their noise.
//
// An alpha-beta filter predicts every point by its velocity, and corrects it by a share of what is
// measured. Kalata's tracking index (IEEE Trans. AES 20 (1984) 174) gives the share: the acceleration that
// a point may have, times the square of the time, over the noise. Two low-pass filters of the same share
// follow, which take from the jerk; the velocity makes up for their lag. Without noise, all shares are 1,
// and samples pass as they are.
#pragma once

#include <optional>

#include "noise.hpp"
#include "step.hpp"

namespace handmap {

// A longer gap in time starts the filter again [s].
constexpr double kLongestGap = 0.5;
// Lever that turns the wrist's angles into lengths [m].
constexpr double kHandLever = 0.1;
// Time in which the speed of a point is forgotten: where it turns, it is slow [s].
constexpr double kSpeedMemory = 0.25;
// Noise below this counts as this [m].
constexpr double kLeastSmoothed = 1e-9;
// Noise above this is not worth the lag that it would cost [m].
constexpr double kMostSmoothed = 0.004;
// Largest correction that is left out, over the noise.
constexpr double kFarthestLeftOut = 3.0;
// A tracking index below this counts as this: samples count, however little.
constexpr double kLeastIndex = 1e-9;

// See stream.smoothing.Smoothing.
struct Smoothing {
  double acceleration = 0.4;  // that a point at rest may have [m/s^2]
  double speed_gain = 12.0;   // rise of the acceleration with the speed of a point [1/s]
};

// Where a hand is: points in wrist axes, with the wrist's position behind them [m]. Without a wrist, points
// are in the world, and the wrist is its origin.
struct Place {
  std::vector<Vec3> points;
  Mat3 rotation;
  bool has_wrist = false;

  void set(const HumanPose& pose) {
    const size_t count = pose.points.size();
    const Pose origin = pose.origin();
    points.resize(count + 1);
    for (size_t i = 0; i < count; ++i) points[i] = pose.in_wrist(i);
    points[count] = origin.p;
    rotation = origin.R;
    has_wrist = pose.has_wrist;
  }
  void clear() {
    points.clear();
    rotation = {};
    has_wrist = false;
  }
  // Write the pose of the hand.
  void write(HumanPose& to) const {
    const size_t count = points.size() - 1;
    to.has_wrist = has_wrist;
    to.wrist = has_wrist ? Pose{rotation, points[count]} : Pose{};
    to.points.resize(count);
    for (size_t i = 0; i < count; ++i) to.points[i] = has_wrist ? to.wrist * points[i] : points[i];
  }
  // Write the way to another place; turns in own axes are the last.
  void to(const Place& other, std::vector<Vec3>& way) const {
    const size_t count = points.size();
    way.resize(count + 1);
    for (size_t i = 0; i < count; ++i) way[i] = other.points[i] - points[i];
    way[count] = log3(transposed(rotation) * other.rotation);
  }
  void move(const std::vector<Vec3>& way) {
    rotation = rotation * exp3(way.back());
    for (size_t i = 0; i < points.size(); ++i) points[i] += way[i];
  }
};

constexpr int kStages = 3;

// State of the filter after a sample.
struct SmoothState {
  double noise = 0.0;   // running estimate of the noise of the points [m]; 0 before there is one
  double waited = 0.0;  // since the sample came [s]
  double dt = 0.0;      // between it and the one before [s]; 0 for a first one
  Place seen{};         // the sample; without points to start again
  Place stages[kStages]{};   // where the three filters are; the last one is the smoothed sample
  std::vector<Vec3> moving;  // velocity of the sample's points [m/s]
  std::vector<Vec3> speeds;  // smoothed velocities, as of `Place::to` [m/s, rad/s]
  Vector recent;             // largest recent speeds, of the turn at a lever [m/s]

  // Forget all but the noise.
  void restart() {
    waited = dt = 0.0;
    seen.clear();
    for (Place& stage : stages) stage.clear();
    moving.clear();
    speeds.clear();
    recent.clear();
  }
};

class Smoother {
 public:
  std::optional<Smoothing> options;  // none: samples pass as they are
  SmoothState state{}, former{};

  // Smooth the next sample in place, `dt` after the last call [s]; one that repeats is the same one.
  void smooth(HumanPose& pose, double dt) {
    if (!options) return;
    former = state;
    Place& seen = seen_;
    seen.set(pose);
    dt += state.waited;
    state.waited = 0.0;
    if (state.seen.points.size() != seen.points.size() || dt > kLongestGap ||
        state.seen.has_wrist != seen.has_wrist) {
      start(seen);
    } else if (is_same(seen)) {
      state.waited = dt;
    } else {
      follow(seen, dt);
    }
    std::swap(state.seen, seen);
    state.stages[kStages - 1].write(pose);
  }
  // Let time pass without a sample [s].
  void wait(double dt) { state.waited += dt; }
  // Let the next sample pass as it is, and go on from there with the noise that is known.
  void restart() { state.restart(); }
  // Forget the sample that was smoothed last.
  void forget() { state = former; }

 private:
  // Memory that is used again for each sample: the sample, and what `follow` and `filter` work with.
  Place seen_, at_;
  std::vector<Vec3> ahead_, way_, part_;
  Vector alpha_, changes_;

  bool is_same(const Place& seen) const {
    for (size_t i = 0; i < seen.points.size(); ++i) {
      const Vec3 &a = state.seen.points[i], &b = seen.points[i];
      if (!(a.x == b.x && a.y == b.y && a.z == b.z)) return false;
    }
    return std::equal(std::begin(seen.rotation.m), std::end(seen.rotation.m),
                      std::begin(state.seen.rotation.m));
  }

  void start(const Place& seen) {
    state.dt = 0.0;
    state.moving.assign(seen.points.size() - 1, Vec3{});
    state.speeds.assign(seen.points.size() + 1, Vec3{});
    state.recent.assign(state.speeds.size(), 0.0);
    for (Place& stage : state.stages) stage = seen;
  }

  void follow(const Place& seen, double dt) {
    const size_t n = state.moving.size();
    Vector& changes = changes_;
    changes.resize(n);
    for (size_t i = 0; i < n; ++i) {
      const Vec3 d = seen.points[i] - state.seen.points[i];
      const Vec3 moving{d.x / dt, d.y / dt, d.z / dt};
      changes[i] = norm(moving - state.moving[i]);
      state.moving[i] = moving;
    }
    if (state.dt > 0.0) {
      const double rate = change_rate(dt, state.dt);
      const double own = noise_of(changes.data(), n, rate);
      state.noise = learnt_noise(state.noise, own);
    }
    state.dt = dt;
    state.noise = std::max(state.noise, kLeastSmoothed);
    filter(seen, dt);
  }

  void filter(const Place& seen, double dt) {
    const double noise = state.noise, capped = std::min(noise, kMostSmoothed);
    const double kept = std::exp(-dt / kSpeedMemory);
    std::vector<Vec3>& speeds = state.speeds;
    const size_t n = speeds.size();
    std::vector<Vec3>&ahead = ahead_, &way = way_, &part = part_;
    Vector& alpha = alpha_;
    Place& at = at_;
    ahead.resize(n);
    part.resize(n);
    alpha.resize(n);
    for (size_t i = 0; i < n; ++i) ahead[i] = dt * speeds[i];
    at = state.stages[0];
    at.move(ahead);
    at.to(seen, way);
    for (size_t i = 0; i < n; ++i) {
      const double lever = i + 1 < n ? 1.0 : kHandLever;
      double& recent = state.recent[i];
      recent = std::max(lever * norm(speeds[i]), kept * recent);
      const double acceleration = options->acceleration + options->speed_gain * recent;
      const double index = std::max(acceleration * dt * dt / capped, kLeastIndex);
      // alpha is 1 - r^2, beta is 2 (1 - r)^2.
      const double r = 4.0 / (4.0 + index + std::sqrt(8.0 * index + index * index));
      const double farthest = kFarthestLeftOut * noise / std::max(lever * norm(way[i]), noise);
      const double left = std::min(r * r, farthest), root = 1.0 - std::sqrt(left);
      alpha[i] = 1.0 - left;
      speeds[i] = speeds[i] + 2.0 * (root * root) / dt * way[i];
      part[i] = alpha[i] * way[i];
      ahead[i] = 2.0 * left / alpha[i] * dt * speeds[i];
    }
    at.move(part);
    state.stages[0] = at;
    at.move(ahead);
    for (int k = 1; k < kStages; ++k) {
      Place& stage = state.stages[k];
      stage.to(at, part);
      for (size_t i = 0; i < n; ++i) part[i] = alpha[i] * part[i];
      stage.move(part);
      at = stage;
    }
  }
};

}  // namespace handmap
