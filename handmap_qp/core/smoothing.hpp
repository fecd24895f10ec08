// Smoothing of samples by their noise: see handmap_qp/stream/follower.py, whose names these are.
#pragma once

#include "noise.hpp"
#include "step.hpp"

namespace handmap {

struct SmoothRules {
  bool is_on = false;
  double acceleration, speed_gain, farthest;
  double longest_gap, hand, memory, least_noise, most_noise, least_index;
  NoiseRules noise;
};

// See follower._Place.
struct Place {
  std::vector<Vec3> points;
  Mat3 rotation;
  bool has_wrist = false;

  static Place of(const HumanPose& pose) {
    Place place{pose.in_wrist(), {}, pose.has_wrist};
    place.points.push_back(pose.has_wrist ? pose.wrist.p : Vec3{});
    if (pose.has_wrist) place.rotation = pose.wrist.R;
    return place;
  }
  HumanPose pose() const {
    HumanPose found{points, has_wrist, {}};
    found.points.pop_back();
    if (!has_wrist) return found;
    found.wrist = {rotation, points.back()};
    for (Vec3& point : found.points) point = found.wrist * point;
    return found;
  }
  // The way to another place; turns in own axes are the last.
  std::vector<Vec3> to(const Place& other) const {
    std::vector<Vec3> way;
    way.reserve(points.size() + 1);
    for (size_t i = 0; i < points.size(); ++i) way.push_back(other.points[i] - points[i]);
    way.push_back(log3(transposed(rotation) * other.rotation));
    return way;
  }
  Place moved(const std::vector<Vec3>& way) const {
    Place found{points, rotation * exp3(way.back()), has_wrist};
    for (size_t i = 0; i < points.size(); ++i) found.points[i] = points[i] + way[i];
    return found;
  }
};

constexpr int kStages = 3;

struct SmoothState {
  double noise = 0.0, waited = 0.0, dt = 0.0;
  Place seen{}, stages[kStages]{};  // `seen` has no points to start again
  std::vector<Vec3> moving, speeds;
  Vector recent;
};

// See follower.Smoother.
class Smoother {
 public:
  SmoothRules rules;
  SmoothState state{}, former{};

  HumanPose smooth(HumanPose&& pose, double dt) {
    if (!rules.is_on) return std::move(pose);
    former = state;
    Place seen = Place::of(pose);
    dt += state.waited;
    state.waited = 0.0;
    if (state.seen.points.size() != seen.points.size() || dt > rules.longest_gap ||
        state.seen.has_wrist != seen.has_wrist) {
      start(seen);
    } else if (is_same(seen)) {
      state.waited = dt;
    } else {
      follow(seen, dt);
    }
    state.seen = std::move(seen);
    return state.stages[kStages - 1].pose();
  }
  void wait(double dt) { state.waited += dt; }
  void restart() {
    const double noise = state.noise;
    state = SmoothState();
    state.noise = noise;
  }
  void forget() { state = former; }

 private:
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
    Vector changes(n);
    for (size_t i = 0; i < n; ++i) {
      const Vec3 d = seen.points[i] - state.seen.points[i];
      const Vec3 moving{d.x / dt, d.y / dt, d.z / dt};
      changes[i] = norm(moving - state.moving[i]);
      state.moving[i] = moving;
    }
    if (state.dt > 0.0) {
      const double rate = change_rate(dt, state.dt);
      const double own = noise_of(rules.noise, changes.data(), static_cast<int>(n), rate);
      state.noise = learnt_noise(rules.noise, state.noise, own);
    }
    state.dt = dt;
    state.noise = std::max(state.noise, rules.least_noise);
    filter(seen, dt);
  }

  void filter(const Place& seen, double dt) {
    const double noise = state.noise, capped = std::min(noise, rules.most_noise);
    const double kept = std::exp(-dt / rules.memory);
    std::vector<Vec3>& speeds = state.speeds;
    const size_t n = speeds.size();
    std::vector<Vec3> ahead(n), part(n);
    for (size_t i = 0; i < n; ++i) ahead[i] = dt * speeds[i];
    Place at = state.stages[0].moved(ahead);
    const std::vector<Vec3> way = at.to(seen);
    Vector alpha(n);
    for (size_t i = 0; i < n; ++i) {
      const double lever = i + 1 < n ? 1.0 : rules.hand;
      double& recent = state.recent[i];
      recent = std::max(lever * norm(speeds[i]), kept * recent);
      const double acceleration = rules.acceleration + rules.speed_gain * recent;
      const double index = std::max(acceleration * dt * dt / capped, rules.least_index);
      const double r = 4.0 / (4.0 + index + std::sqrt(8.0 * index + index * index));
      const double farthest = rules.farthest * noise / std::max(lever * norm(way[i]), noise);
      const double left = std::min(r * r, farthest), root = 1.0 - std::sqrt(left);
      alpha[i] = 1.0 - left;
      speeds[i] = speeds[i] + 2.0 * (root * root) / dt * way[i];
      part[i] = alpha[i] * way[i];
      ahead[i] = 2.0 * left / alpha[i] * dt * speeds[i];
    }
    state.stages[0] = at.moved(part);
    at = state.stages[0].moved(ahead);
    for (int k = 1; k < kStages; ++k) {
      part = state.stages[k].to(at);
      for (size_t i = 0; i < n; ++i) part[i] = alpha[i] * part[i];
      state.stages[k] = at = state.stages[k].moved(part);
    }
  }
};

}  // namespace handmap
