// Which samples of a tracker make sense: see handmap_qp/stream/guard.py, whose names these are.
#pragma once

#include "input.hpp"
#include "noise.hpp"

namespace handmap {

// In the order of human.sample.Rule.
enum Rule {
  kNothing, kMissing, kZero, kSize, kOutlier, kJump, kFlipped, kFrozen, kGapped, kSettling,
  kDuplicate, kDisorder, kClockJump, kTime, kUnit, kOrder, kSide, kFlexion, kWrist, kUnproven
};
constexpr const char* kRuleNames[] = {
    "",          "missing",  "zero",       "size", "outlier", "jump",  "flip", "frozen",  "gap",
    "settling",  "duplicate", "disorder",  "clock_jump", "time", "unit", "order", "side",
    "flexion",   "wrist",    "unproven"};

constexpr int kFixed = 23, kSizes = 8;

// Numbers of Python.
struct GuardRules {
  // SampleClock and RateCheck
  double longest_step, gap, behind, set_back, set_forward, period_share, shortest_step;
  int late_samples;
  double rate_window, largest_drift, credit_rate;
  // Motion
  int starts[kFixed], ends[kFixed];
  double zero_size, mirror, alone, believed[kSizes], noisy[kSizes], first_noise;
  NoiseRules noise;
  // Rules
  double frozen_after, settling, long_settling, brief, palm_ratios[2];
};

// -- time

struct Tick {
  Rule rule;
  double elapsed, dt, passed;
};

struct SampleClock {
  bool has_stamp = false, is_idle = false;
  int late_count = 0;
  double stamp = 0.0, period = 1.0 / 60.0, late_stamp = 0.0;

  // Judge a time stamp, and go on to it.
  Tick advance(const GuardRules& rules, double time) {
    const double usual = period, step = time - stamp;
    const bool was_idle = is_idle;
    if (!has_stamp) {
      has_stamp = true;
      stamp = time;
      return {kNothing, period, period, period};
    }
    if (step == 0.0) {
      is_idle = true;
      return {kDuplicate, 0.0, 0.0, 0.0};
    }
    if (-rules.set_back <= step && step < 0.0) {
      const int count = 1 + (time > late_stamp ? late_count : 0);
      if (count < rules.late_samples) {
        late_stamp = time;
        late_count = count;
        is_idle = true;
        return {kDisorder, 0.0, 0.0, 0.0};
      }
    }
    *this = SampleClock();
    has_stamp = true;
    stamp = time;
    period = usual;
    const double passed = std::max(step, 0.0);
    if (step < 0.0 || step > rules.set_forward) return {kClockJump, period, period, passed};
    if (step > rules.gap) return {kGapped, step, period, passed};
    period = usual + rules.period_share * (step - usual);
    const double longest = was_idle ? usual : rules.longest_step * usual;
    return {kNothing, step, std::min(step, longest), passed};
  }
};

struct RateCheck {
  double start = std::numeric_limits<double>::quiet_NaN(), former = start;
  double lead = 0.0, drift = 0.0, rate = 1.0;
  bool is_off = false;
  int finding = kNone;
  bool has_arrival = false;
  // The time that the next samples may account for.
  double last_arrival = 0.0, credit = HUGE_VAL;

  // Bound the time of the next sample by the time that has passed at its arrival.
  double grant(const GuardRules& rules, double dt, double arrival) {
    const double passed = has_arrival ? std::max(arrival - last_arrival, 0.0) : 0.0;
    has_arrival = true;
    last_arrival = arrival;
    credit = std::min(credit + rules.credit_rate * passed, rules.gap);
    const double granted = std::min(dt, credit);
    credit -= granted;
    return granted;
  }

  // Whether another rate was measured, of the time of the stream against that of arrival.
  bool update(const GuardRules& rules, double stamp, double arrival) {
    if (std::isnan(start)) start = arrival;
    const double elapsed = arrival - start;
    const bool is_new = elapsed >= rules.rate_window;
    if (is_new) {
      // NaN, before there is a former half second, is no drift.
      const double before = drift;
      drift = (lead - former) / elapsed;
      is_off = drift * before > 0.0 &&
               std::min(std::abs(drift), std::abs(before)) > rules.largest_drift;
      rate = 1.0 + drift;
      start = arrival;
      former = lead;
    }
    lead = stamp - arrival;
    return is_new;
  }
};

// -- motion

struct Track {
  double time = 0.0;
  Landmarks points;  // from the palm's centre
  Vec3 centre;
  std::array<double, kFixed> lengths;
  Vec3 velocity, turning;
  Landmarks bending{};
  double dt = 0.0;
};

struct Change {
  double sizes[kSizes], rates[kSizes], noise;
  bool is_known, is_mirrored, is_alone;
};

inline Vec3 palm_centre(const Landmarks& points) {
  Vec3 centre;
  for (const int i : kPalm) centre += 0.2 * points[i];
  return centre;
}

inline double palm_size(const Landmarks& points) {
  const Vec3 centre = palm_centre(points);
  double sum = 0.0;
  for (const int i : kPalm) sum += dot(points[i] - centre, points[i] - centre);
  return std::sqrt(sum / 5.0);
}

inline bool is_zero(const GuardRules& rules, const Landmarks& points) {
  int seen = 0;
  for (const Vec3& p : points) seen += p.x != 0.0 || p.y != 0.0 || p.z != 0.0;
  return palm_size(points) < rules.zero_size || seen < kLandmarks - 1;
}

inline Track first_track(const GuardRules& rules, double now, const Landmarks& landmarks) {
  Track track;
  track.time = now;
  track.centre = palm_centre(landmarks);
  for (int i = 0; i < kLandmarks; ++i) track.points[i] = landmarks[i] - track.centre;
  for (int k = 0; k < kFixed; ++k)
    track.lengths[k] = norm(landmarks[rules.ends[k]] - landmarks[rules.starts[k]]);
  return track;
}

inline bool is_same(const Vec3& a, const Vec3& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

inline bool is_same_hand(const Track& before, const Track& sample) {
  for (int i = 0; i < kLandmarks; ++i)
    if (!is_same(before.points[i], sample.points[i])) return false;
  return is_same(before.centre, sample.centre);
}

// Measure the motion from a track to a sample, which takes it over.
inline Change change_between(const GuardRules& rules, const Track& track, Track& sample,
                             double dt) {
  Mat3 covariance = 0.0 * Mat3{}, whole = covariance;
  for (const int i : kPalm)
    covariance = covariance + outer(sample.points[i], track.points[i]);
  for (int i = 0; i < kLandmarks; ++i) whole = whole + outer(sample.points[i], track.points[i]);
  const Mat3 rotation = nearest_rotation(covariance);
  const Vec3 turn = log3(rotation);
  const bool is_known = track.dt > 0.0;
  const double former = is_known ? track.dt : dt, span = 0.5 * (dt + former);
  sample.velocity = (1.0 / dt) * (sample.centre - track.centre);
  sample.turning = (1.0 / dt) * turn;
  sample.dt = dt;
  double fastest = 0.0, second = 0.0, fingers = 0.0, slips[kLandmarks];
  for (int i = 0; i < kLandmarks; ++i) {
    const Vec3 moved = (1.0 / dt) * (tmul(rotation, sample.points[i]) - track.points[i]);
    sample.bending[i] = rotation * moved;
    fastest = std::max(fastest, norm(moved));
    const double slip = is_known ? norm(moved - track.bending[i]) : 0.0;
    second = std::max(second, std::min(slip, fingers));
    fingers = std::max(fingers, slip);
    slips[i] = slip;
  }
  double palm = 0.0, turned = 0.0, stretch = 0.0;
  if (is_known) {
    palm = norm(sample.velocity - track.velocity);
    turned = norm(sample.turning - track.turning);
  }
  for (int k = 0; k < kFixed; ++k)
    stretch = std::max(stretch, std::abs(sample.lengths[k] - track.lengths[k]));
  const double angle = norm(turn), rate = change_rate(dt, former), step = 1.0 / dt;
  // A reflection that lays one hand better on the other than any rotation does.
  const bool is_mirrored = determinant(whole) < 0.0 && svd3(whole).s[2] < -rules.mirror;
  return {{palm / span, turned / span, fingers / span, stretch, norm(sample.velocity), angle / dt,
           fastest, angle},
          {rate / span, rate / span, rate / span, 1.0, step, step, step, 1.0},
          is_known ? noise_of(rules.noise, slips, kLandmarks, rate) : 0.0,
          is_known,
          is_mirrored,
          fingers > rules.alone * second};
}

// -- rules

struct StreamSample {
  double time;
  const double* landmarks;  // (21, 3)
  const double* wrist;      // (4, 4), or null
  bool valid;
  double confidence;
  double arrival;  // NaN: none
};

struct Verdict {
  int rule;
  bool is_held, is_return;
  double dt, consistency;
  int finding;
  double lost = HUGE_VAL;
  double time = 0.0;  // of the stream
};

struct GuardState {
  SampleClock clock;
  double now = 0.0, time = 0.0;
  bool has_good = false, has_last = false;
  Track good, last;
  double noise = 0.0;
  int cause = kNothing;
  double steady_since = 0.0;
};

// See guard.StreamGuard.
class StreamGuard {
 public:
  const GuardRules& rules;
  double palm;                        // RMS radius
  std::array<double, kFixed> person;  // the distances that cannot change
  GuardState state{};
  RateCheck rate;
  InputCheck input;

  StreamGuard(const GuardRules& own_rules, const InputRules& input_rules, double sign,
              Explainer& explainer)
      : rules(own_rules), input(input_rules, sign, explainer) {}

  // Judge the next sample; without the GIL, which only the explainer takes.
  Verdict check(const StreamSample& sample) {
    SampleClock clock = state.clock;
    const bool was_late = clock.late_count > 0;
    Tick tick = clock.advance(rules, sample.time);
    if (!std::isnan(sample.arrival)) {
      const double granted = rate.grant(rules, tick.dt, sample.arrival);
      // Stamps that outrun arrival do not move the robot's clock either.
      if (granted < tick.dt) tick.passed = std::min(tick.passed, granted);
      tick.dt = granted;
    }
    const double now = state.now + tick.elapsed, time = state.time + tick.passed;
    Verdict verdict{tick.rule, true, false, tick.dt, std::numeric_limits<double>::quiet_NaN(),
                    kNone};
    verdict.time = time;
    Landmarks landmarks;
    const bool is_new = tick.rule != kDuplicate && tick.rule != kDisorder;
    int rule = kNothing;
    if (is_new) rule = input_fault(sample, now, landmarks, verdict.finding);
    // Nothing is thrown from here on.
    state.clock = clock;
    state.now = now;
    state.time = time;
    if (!is_new) return verdict;
    if (rule != kNothing) {
      hold(rule);
      verdict.rule = rule;
      return verdict;
    }
    const int cause = state.cause;
    verdict = follow(first_track(rules, now, landmarks), tick, was_late);
    verdict.time = time;
    if (state.cause != kNothing && cause == kNothing) input.alert();
    if (sample.wrist && !input.state.seen.is_proven && !verdict.is_held) verdict.rule = kUnproven;
    return verdict;
  }

 private:
  int input_fault(const StreamSample& sample, double now, Landmarks& landmarks, int& finding) {
    if (!std::isnan(sample.arrival) && rate.update(rules, now, sample.arrival)) {
      rate.finding = kNone;
      if (rate.is_off) rate.finding = input.explainer.explain_rate(rate.rate);
    }
    if (!std::isnan(sample.arrival) && rate.finding != kNone) {
      finding = rate.finding;
      return kTime;
    }
    if (!sample.valid || sample.confidence == 0.0) return kMissing;
    landmarks = landmarks_of(sample.landmarks);
    if (is_zero(rules, landmarks)) return kZero;
    Pose wrist;
    if (sample.wrist) wrist = pose_of(sample.wrist);
    finding = input.update(sample.time, landmarks, sample.wrist ? &wrist : nullptr);
    if (finding != kNone) return input.explainer.rule_of(finding);
    const double ratio = palm_size(landmarks) / palm;
    return ratio >= rules.palm_ratios[0] && ratio <= rules.palm_ratios[1] ? kNothing : kSize;
  }

  // Judge landmarks that could be a hand's by how they follow the ones before.
  Verdict follow(const Track& fresh, const Tick& tick, bool was_late) {
    double sum = 0.0;
    for (int k = 0; k < kFixed; ++k) {
      const double off = fresh.lengths[k] - person[k];
      sum += off * off;
    }
    Verdict verdict{kNothing, false, false, tick.dt, std::sqrt(sum / kFixed), kNone};
    const bool was_held = state.cause != kNothing;
    if (!state.has_last) {
      state.good = state.last = fresh;
      state.has_good = state.has_last = true;
      state.cause = kNothing;
      verdict.is_return = was_held;
      return verdict;
    }
    verdict.is_held = true;
    const double since_last = state.now - state.last.time;
    int rule = kNothing;
    // A tracker that is slower than its samples repeats them, which is no motion.
    if (!is_same_hand(state.last, fresh)) {
      rule = moved(fresh);
    } else if (since_last >= rules.frozen_after) {
      hold(kFrozen);
      verdict.rule = kFrozen;
      return verdict;
    }
    // Nothing is known of the time of a gap: the hand is where it was, or not.
    const bool is_back = since_last > rules.gap ? rule == kNothing : has_returned(fresh, rule);
    if (state.cause != kNothing && !is_back) {
      verdict.rule = rule != kNothing ? rule : kSettling;
      return verdict;
    }
    verdict.lost = lost();
    verdict.rule = tick.rule;
    verdict.is_held = false;
    verdict.is_return = tick.rule == kGapped || was_late ||
                        (state.cause != kNothing && verdict.lost / state.clock.period >
                                                         rules.longest_step + rules.shortest_step);
    state.good = state.last;
    state.has_good = true;
    state.cause = kNothing;
    return verdict;
  }

  // Whether a hold is over: the hand is near where it was, or steady where it is.
  bool has_returned(const Track& fresh, int rule) const {
    if (!state.has_good) return rule == kNothing;
    Track at = fresh;
    const double since = std::max(state.now - state.good.time, shortest());
    if (since <= rules.brief)
      return named(change_between(rules, state.good, at, since)) == kNothing;
    if (rule != kNothing) return false;
    double settling = rules.settling;
    if (state.cause == kFlipped || state.cause == kOutlier) {
      // The hand may still be turned, mirrored or of other lengths.
      if (named(change_between(rules, state.good, at, 1.0)) != kNothing)
        settling = rules.long_settling;
    }
    return state.now - state.steady_since >= settling;
  }

  // Name what no hand does from one sample to the next, and learn the noise.
  int moved(const Track& fresh) {
    const Track& last = state.last;
    Track at = fresh;
    const double since = std::max(state.now - last.time, shortest());
    const Change change = change_between(rules, last, at, since);
    const bool is_gap = since > rules.gap;
    if (change.is_known && !is_gap)
      state.noise = learnt_noise(rules.noise, state.noise, change.noise);
    int rule = named(change);
    if (is_gap) {
      Track near = fresh;
      if (named(change_between(rules, last, near, state.clock.period)) != kNothing)
        rule = state.cause != kNothing ? kSettling : kGapped;
    }
    state.last = rule != kNothing ? fresh : at;
    if (rule != kNothing) hold(rule);
    return rule;
  }

  // Begin a hold, or go on with it; samples must make sense again from now on. A few that are lost
  // meanwhile do not count.
  void hold(int rule) {
    if (state.cause == kNothing) state.cause = rule;
    const bool is_brief =
        rule == kMissing && state.has_last && state.now - state.last.time <= rules.brief;
    if (!is_brief) state.steady_since = state.now;
  }

  bool is_excess(const Change& change, int i) const {
    return change.sizes[i] >
           rules.believed[i] + state.noise * rules.noisy[i] * change.rates[i];
  }

  int named(const Change& change) const {
    if (is_excess(change, 7) || change.is_mirrored) return kFlipped;
    bool is_any = false;
    for (int i = 0; i < kSizes; ++i) is_any = is_any || is_excess(change, i);
    if (!is_any) return kNothing;
    return change.is_alone || is_excess(change, 3) ? kOutlier : kJump;
  }

  double shortest() const { return rules.shortest_step * state.clock.period; }
  // Time without a sample, where that is brief and nothing else is wrong.
  double lost() const {
    if (state.cause != kMissing || !state.has_good) return HUGE_VAL;
    const double time = state.now - state.good.time;
    return time <= rules.brief ? time : HUGE_VAL;
  }
};

}  // namespace handmap
