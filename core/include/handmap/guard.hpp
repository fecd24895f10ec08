// Which samples of a tracker make sense, by named rules.
//
// Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros. The
// guard compares every sample with the person's hand and with the sample before, and says whether the
// robot may follow it.
#pragma once

#include "input.hpp"
#include "stream_clock.hpp"

namespace handmap {

// A hand whose palm has a smaller RMS radius is no hand but a point [m].
constexpr double kZeroSize = 0.001;
// Size of a sample's palm over the hand's own, which is constant; 0.87 to 1.12 in recordings.
constexpr double kPalmRatios[2] = {0.5, 2.0};
// Smallest part of the squared landmark spread that must speak for a mirror image [m^2].
constexpr double kMirror = 1e-4;
// A landmark that leaves its place alone is this many times as fast as the next one.
constexpr double kAlone = 3.0;

// `Change::sizes` that are believed of a tracker without noise. Recordings of free motion reach 1.5 m/s,
// 22 rad/s and 3.8 m/s. The last is 60 degrees.
constexpr int kSizes = 8;
constexpr double kBelieved[kSizes] = {60.0, 600.0, 150.0, 0.008, 6.0, 40.0, 6.0, 1.0471975511965976};
// What noise adds to them, over the noise [m] and `Change::rates`: twice what white noise does.
constexpr double kNoisySizes[kSizes] = {6.0, 150.0, 20.0, 25.0, 4.0, 100.0, 8.0, 50.0};
// Noise of a tracker before it is known: that of a poor one [m].
constexpr double kFirstNoise = 0.002;

// Landmarks that repeat exactly for longer are frozen, and not those of a slow tracker [s].
constexpr double kFrozenAfter = 0.5;
// Time that samples must make sense before they are followed again, after a fault [s], and after a flip
// or an outlier, which can last.
constexpr double kSettleTime = 0.1, kLongSettleTime = 0.5;
// Holds up to this end at once when the hand is where it can have moved to meanwhile [s].
constexpr double kBrief = 0.12;
// Share of the speed limits at which the robot follows a wrist that is not proven yet.
constexpr double kUnprovenSpeed = 0.25;

// -- motion

// A sample and the motion that led to it; velocities are zero for a first sample.
struct Track {
  double time = 0.0;                   // in the time of the clock [s]
  Landmarks points;                    // from the palm's centre [m]
  Vec3 centre;                         // of the palm [m]
  std::array<double, kFixed> lengths;  // the distances that cannot change [m]
  Vec3 velocity, turning;              // of the centre [m/s]; of the palm [rad/s]
  Landmarks bending{};                 // velocities of the landmarks in palm axes [m/s]
  double dt = 0.0;                     // since the sample before [s]; 0 for a first one
};

// Motion from a track to a sample.
struct Change {
  // Change of the palm's velocity [m/s^2], and of its angular velocity [rad/s^2]; largest change of a
  // landmark's velocity in palm axes [m/s^2], and of a distance that cannot change [m]; speeds likewise
  // [m/s, rad/s, m/s]; angle of the turn [rad]. The first three are 0 if no motion before is known.
  double sizes[kSizes];
  // How noise [m] adds to the sizes: by one over time, or over time squared.
  double rates[kSizes];
  double noise;      // of the landmarks in palm axes [m]; 0 likewise
  bool is_known;     // whether a motion before is
  bool is_mirrored;  // the hand became its mirror image
  bool is_alone;     // one landmark changed its velocity far more than all others
};

inline Vec3 palm_centre(const Landmarks& points) {
  Vec3 centre;
  for (const int i : kPalm) centre += 0.2 * points[i];
  return centre;
}

// RMS distance of the palm's landmarks from their centre [m].
inline double palm_size(const Landmarks& points) {
  const Vec3 centre = palm_centre(points);
  double sum = 0.0;
  for (const int i : kPalm) sum += dot(points[i] - centre, points[i] - centre);
  return std::sqrt(sum / 5.0);
}

// Whether landmarks lie in one place, or all but one at the origin: one may be the origin of the
// tracker's world.
inline bool is_zero(const Landmarks& points) {
  int seen = 0;
  for (const Vec3& p : points) seen += p.x != 0.0 || p.y != 0.0 || p.z != 0.0;
  return palm_size(points) < kZeroSize || seen < kLandmarks - 1;
}

// The distances that cannot change [m].
inline std::array<double, kFixed> fixed_lengths(const Landmarks& landmarks) {
  std::array<double, kFixed> lengths;
  for (int k = 0; k < kFixed; ++k)
    lengths[k] = norm(landmarks[kEnds[k][1]] - landmarks[kEnds[k][0]]);
  return lengths;
}

// A sample without motion.
inline Track first_track(double now, const Landmarks& landmarks) {
  Track track;
  track.time = now;
  track.centre = palm_centre(landmarks);
  for (int i = 0; i < kLandmarks; ++i) track.points[i] = landmarks[i] - track.centre;
  track.lengths = fixed_lengths(landmarks);
  return track;
}

inline bool is_same(const Vec3& a, const Vec3& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

inline bool is_same_hand(const Track& before, const Track& sample) {
  for (int i = 0; i < kLandmarks; ++i)
    if (!is_same(before.points[i], sample.points[i])) return false;
  return is_same(before.centre, sample.centre);
}

// Measure the motion from a track to a sample, which takes it over, `dt` later [s].
inline Change change_between(const Track& track, Track& sample, double dt) {
  Mat3 covariance = 0.0 * Mat3{}, whole = covariance;
  for (const int i : kPalm)
    covariance = covariance + outer(sample.points[i], track.points[i]);
  for (int i = 0; i < kLandmarks; ++i) whole = whole + outer(sample.points[i], track.points[i]);
  // Kabsch: the rotation that takes the palm before to the palm now.
  const Mat3 rotation = nearest_rotation(covariance);
  const Vec3 turn = log3(rotation);
  const bool is_known = track.dt > 0.0;
  // No motion is known before a first sample: speeds decide.
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
  const bool is_mirrored = determinant(whole) < 0.0 && svd3(whole).s[2] < -kMirror;
  return {{palm / span, turned / span, fingers / span, stretch, norm(sample.velocity), angle / dt,
           fastest, angle},
          {rate / span, rate / span, rate / span, 1.0, step, step, step, 1.0},
          is_known ? noise_of(slips, kLandmarks, rate) : 0.0,
          is_known,
          is_mirrored,
          fingers > kAlone * second};
}

// -- rules

struct StreamSample {
  double time;
  const double* landmarks;  // (21, 3)
  const double* wrist;      // (4, 4), or null
  bool valid;
  double confidence;
  double arrival;  // on a monotonic clock [s]; NaN: none
};

// See human.sample.Verdict, which has the same fields.
struct Verdict {
  int rule;
  bool is_held, is_return;
  double dt;
  double consistency = kNaN;
  Finding finding{};
  double lost = HUGE_VAL;
  double time = 0.0;
};

// What the guard remembers.
struct GuardState {
  SampleClock clock;
  // Time of the stream [s]: the sum of the time steps; and likewise of the times by the stamps, which
  // the robot's commands go by.
  double now = 0.0, time = 0.0;
  // The last sample that was followed; the last that could be a hand's, at the first time that it came.
  bool has_good = false, has_last = false;
  Track good, last;
  double noise = kFirstNoise;  // running estimate of the landmarks' noise [m]
  int cause = kNothing;        // the rule that began the present hold
  double steady_since = 0.0;   // time since which samples make sense [s]

  // Whether rules are rules, which those of a damaged copy may not be.
  bool is_sound() const {
    return kNothing <= clock.rule && clock.rule <= kUnproven && kNothing <= cause &&
           cause <= kUnproven;
  }
};

// Judges the samples of one hand, one after the other.
class StreamGuard {
 public:
  GuardState state{};
  RateCheck rate;
  InputCheck input;

  // Of the landmarks of the person's hand at rest.
  StreamGuard(double sign, const Landmarks& person, std::shared_ptr<const LandmarkOrders> orders)
      : input(sign, std::move(orders)), palm_(palm_size(person)), lengths_(fixed_lengths(person)) {}

  Verdict check(const StreamSample& sample) {
    const SampleClock clock = state.clock.advance(sample.time);
    const bool was_late = state.clock.late_count > 0;
    double dt = clock.dt, passed = clock.passed;
    if (!std::isnan(sample.arrival)) {
      dt = rate.grant(clock.dt, sample.arrival);
      // Stamps that outrun arrival do not move the robot's clock either.
      if (dt < clock.dt) passed = std::min(passed, dt);
    }
    state.clock = clock;
    state.now += clock.elapsed;
    state.time += passed;
    Verdict held{clock.rule, true, false, dt};
    held.time = state.time;
    if (clock.is_idle()) return held;
    Landmarks landmarks;
    if (const int fault = input_fault(sample, landmarks, held.finding)) {
      hold(fault);
      held.rule = fault;
      return held;
    }
    const int cause = state.cause;
    Verdict verdict = follow(first_track(state.now, landmarks), held, was_late);
    if (state.cause != kNothing && cause == kNothing) input.alert();
    const bool is_proven = !sample.wrist || input.state.seen.wrist.is_proven;
    if (!is_proven && !verdict.is_held) verdict.rule = kUnproven;
    return verdict;
  }

 private:
  double palm_;                         // RMS radius of the person's palm [m]
  std::array<double, kFixed> lengths_;  // the distances that cannot change [m]

  // What makes a sample unusable by itself.
  int input_fault(const StreamSample& sample, Landmarks& landmarks, Finding& finding) {
    if (!std::isnan(sample.arrival)) {
      const double found = rate.update(state.now, sample.arrival);
      if (!std::isnan(found)) {
        finding = {Mistake::rate, found};
        return kTime;
      }
    }
    if (!sample.valid || sample.confidence == 0.0) return kMissing;
    landmarks = landmarks_of(sample.landmarks);
    if (is_zero(landmarks)) return kZero;
    Pose wrist;
    if (sample.wrist) wrist = pose_of(sample.wrist);
    finding = input.update(sample.time, landmarks, sample.wrist ? &wrist : nullptr);
    if (!finding.is_none()) return finding.rule();
    const double ratio = palm_size(landmarks) / palm_;
    return kPalmRatios[0] <= ratio && ratio <= kPalmRatios[1] ? kNothing : kSize;
  }

  // Judge landmarks that could be a hand's by how they follow the ones before.
  Verdict follow(const Track& fresh, const Verdict& held, bool was_late) {
    double sum = 0.0;
    for (int k = 0; k < kFixed; ++k) {
      const double off = fresh.lengths[k] - lengths_[k];
      sum += off * off;
    }
    Verdict verdict = held;
    verdict.rule = kNothing;
    verdict.consistency = std::sqrt(sum / kFixed);
    const bool was_held = state.cause != kNothing;
    if (!state.has_last) {
      state.good = state.last = fresh;
      state.has_good = state.has_last = true;
      state.cause = kNothing;
      verdict.is_held = false;
      verdict.is_return = was_held;
      return verdict;
    }
    const double since_last = state.now - state.last.time;
    int rule = kNothing;
    // A tracker that is slower than its samples repeats landmarks exactly, which is no motion.
    if (!is_same_hand(state.last, fresh)) {
      rule = move(fresh);
    } else if (since_last >= kFrozenAfter) {
      hold(kFrozen);
      verdict.rule = kFrozen;
      return verdict;
    }
    if (state.cause != kNothing && !has_returned(fresh, rule, since_last)) {
      verdict.rule = rule != kNothing ? rule : kSettling;
      return verdict;
    }
    verdict.lost = lost();
    // Whether the robot has stood still for longer than one sample accounts for.
    const bool has_paused = verdict.lost / state.clock.period > kLongestStep + kShortestStep;
    verdict.rule = held.rule;
    verdict.is_held = false;
    verdict.is_return =
        held.rule == kGapped || was_late || (state.cause != kNothing && has_paused);
    state.good = state.last;
    state.has_good = true;
    state.cause = kNothing;
    return verdict;
  }

  // Name what no hand does from one sample to the next, and learn the noise.
  int move(const Track& fresh) {
    const Track& last = state.last;
    Track moved = fresh;
    const double since = std::max(state.now - last.time, state.clock.shortest());
    const Change change = change_between(last, moved, since);
    const bool is_gap = since > kGap;
    if (change.is_known && !is_gap) state.noise = learnt_noise(state.noise, change.noise);
    int rule = named(change);
    if (is_gap) {
      Track near = fresh;
      if (named(change_between(last, near, state.clock.period)) != kNothing)
        rule = state.cause != kNothing ? kSettling : kGapped;
    }
    state.last = rule != kNothing ? fresh : moved;
    if (rule != kNothing) hold(rule);
    return rule;
  }

  // Whether a hold is over: the hand is near where it was, or steady where it is.
  bool has_returned(const Track& fresh, int rule, double since_last) const {
    // Nothing is known of the time of a gap.
    if (!state.has_good || since_last > kGap) return rule == kNothing;
    Track moved = fresh;
    const double since_good = std::max(state.now - state.good.time, state.clock.shortest());
    if (since_good <= kBrief)
      return named(change_between(state.good, moved, since_good)) == kNothing;
    if (rule != kNothing) return false;
    double settling = kSettleTime;
    // The hand may still be turned, mirrored or of other lengths.
    const bool can_last = state.cause == kFlipped || state.cause == kOutlier;
    if (can_last && named(change_between(state.good, moved, 1.0)) != kNothing)
      settling = kLongSettleTime;
    return state.now - state.steady_since >= settling;
  }

  // Begin a hold, or go on with it. Samples must make sense from now on, but for brief losses.
  void hold(int rule) {
    if (state.cause == kNothing) state.cause = rule;
    const bool is_brief =
        rule == kMissing && state.has_last && state.now - state.last.time <= kBrief;
    if (!is_brief) state.steady_since = state.now;
  }

  bool is_excess(const Change& change, int i) const {
    return change.sizes[i] > kBelieved[i] + state.noise * kNoisySizes[i] * change.rates[i];
  }

  // Name a change that no hand makes.
  int named(const Change& change) const {
    if (is_excess(change, 7) || change.is_mirrored) return kFlipped;
    bool is_any = false;
    for (int i = 0; i < kSizes; ++i) is_any = is_any || is_excess(change, i);
    if (!is_any) return kNothing;
    return change.is_alone || is_excess(change, 3) ? kOutlier : kJump;
  }

  // Time without a sample, where that is brief and nothing else is wrong [s]; or infinite.
  double lost() const {
    if (state.cause != kMissing || !state.has_good) return HUGE_VAL;
    const double time = state.now - state.good.time;
    return time <= kBrief ? time : HUGE_VAL;
  }
};

}  // namespace handmap
