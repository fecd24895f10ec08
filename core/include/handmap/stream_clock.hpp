// What time stamps mean: they jitter, repeat, arrive in disorder, and jump when the tracker's clock is
// set. All else counts in the time that `SampleClock` gives, never in samples.
#pragma once

#include "finding.hpp"

namespace handmap {

// Longest time that a sample may account for, in usual times between samples.
constexpr double kLongestStep = 3.0;
// A stream that is more than this behind the robot's clock is related to it again [s].
constexpr double kBehind = 1.0;
// A longer time between stamps is a gap: samples are missing, or the clock was set [s].
constexpr double kGap = 0.25;
// A stamp earlier by more than this is of a clock that was set back, not of a late sample [s].
constexpr double kSetBack = 1.0;
// A stamp later by more than this is of a clock that was set forward [s].
constexpr double kSetForward = 10.0;
// Late samples in a row that increase among themselves: the clock was set back a little.
constexpr int kLateSamples = 5;
// Share of a new interval in the usual period.
constexpr double kPeriodShare = 0.05;
// Least interval that speeds are computed from, over the usual period: stamps jitter.
constexpr double kShortestStep = 0.5;
// Time of arrival between two comparisons of the clocks [s].
constexpr double kRateWindow = 0.5;
// Drift of stamps against arrival that a clock or a growing delay may have [s/s].
constexpr double kLargestDrift = 0.3;
// Time that samples may account for in a second of arrival [s/s]: clocks of computers differ by far less.
constexpr double kCreditRate = 1.02;

// State of the clock after a sample; `advance` returns the next one.
struct SampleClock {
  bool has_stamp = false;
  double stamp = 0.0;           // of the last sample that counted [s]
  double period = 1.0 / 60.0;   // usual time between samples [s]
  double late_stamp = 0.0;      // of the last late sample [s]
  int late_count = 0;           // late samples in a row
  // What is unusual about the sample's stamp: duplicate, disorder, gap, clock jump, or nothing.
  Rule rule = kNothing;
  double elapsed = 0.0;  // since the last sample that counted [s]; the usual one after a clock jump
  // Time that the sample accounts for [s], from 0 to `kLongestStep` periods; one period at most after a
  // sample that brought nothing new, for its command has taken the time.
  double dt = 0.0;
  // By the stamps since the last sample that counted [s]; 0 where they go back.
  double passed = 0.0;

  // Whether the sample brings nothing new.
  bool is_idle() const { return rule == kDuplicate || rule == kDisorder; }
  // Whether the sample's stamp is earlier than one before, and counts all the same.
  bool is_set_back() const { return !is_idle() && passed == 0.0; }
  // Least time that speeds are computed over [s]: jitter of stamps is not speed.
  double shortest() const { return kShortestStep * period; }

  // The clock after a sample of a time stamp [s].
  SampleClock advance(double time) const {
    if (!has_stamp) return after(time, kNothing, period, period, period);
    const double step = time - stamp;
    SampleClock idle = *this;
    idle.rule = kDuplicate;
    idle.elapsed = idle.dt = idle.passed = 0.0;
    if (step == 0.0) return idle;
    if (-kSetBack <= step && step < 0.0) {
      const int count = 1 + (time > late_stamp ? late_count : 0);
      if (count < kLateSamples) {
        idle.rule = kDisorder;
        idle.late_stamp = time;
        idle.late_count = count;
        return idle;
      }
    }
    const double since = std::max(step, 0.0);
    if (step < 0.0 || step > kSetForward) return after(time, kClockJump, period, period, since);
    if (step > kGap) return after(time, kGapped, step, period, since);
    const double longest = is_idle() ? period : kLongestStep * period;
    SampleClock next = after(time, kNothing, step, std::min(step, longest), step);
    next.period += kPeriodShare * (step - period);
    return next;
  }

  // The same clock, as if the last stamp had been another one.
  SampleClock at(double time) const {
    SampleClock moved = *this;
    moved.has_stamp = true;
    moved.stamp = time;
    return moved;
  }

 private:
  SampleClock after(double time, Rule own_rule, double since, double granted, double by_stamps) const {
    SampleClock next;
    next.has_stamp = true;
    next.stamp = time;
    next.period = period;
    next.rule = own_rule;
    next.elapsed = since;
    next.dt = granted;
    next.passed = by_stamps;
    return next;
  }
};

// Time that the next samples may account for, by the times at which they arrive.
struct ArrivalCredit {
  double left = kGap;     // that time [s]
  double arrival = kNaN;  // when the last sample arrived [s]; NaN before the first one

  // Bound the time that the next sample accounts for by its stamp by the time that has passed at its
  // arrival on a monotonic clock [s], so that samples account for no more time than has passed since any
  // of them arrived, and 2 % of it and `kGap` more. Samples that arrive at once behind a stall of up to
  // `kGap` keep their time.
  double spend(double dt, double now) {
    // The NaN before the first sample is no time.
    const double passed = now - arrival > 0.0 ? now - arrival : 0.0;
    left = std::min(left + kCreditRate * passed, kGap);
    arrival = now;
    const double granted = std::min(dt, left);
    left -= granted;
    return granted;
  }
};

// Compares the time of a stream with the time at which its samples arrive, every half second. Two in a
// row must drift the same way: a stall, the burst behind it and a clock set do not. `grant` bounds what
// samples may account for in the meantime, whatever their stamps say.
struct RateCheck {
  double start = kNaN, former = kNaN, lead = kNaN, drift = 0.0;
  // Seconds of the stream in a second of arrival; NaN if no two half seconds in a row differ from 1 by
  // more than 30 %.
  double rate = kNaN;
  ArrivalCredit credit;

  double grant(double dt, double arrival) { return credit.spend(dt, arrival); }

  // Take the next sample, by its instant in the time of `SampleClock` [s]; return `rate`.
  double update(double stamp, double arrival) {
    // NaN: at the first sample, a half second begins; without a former one, drift is not known.
    if (!(arrival - start < kRateWindow)) {
      const double before = drift;
      drift = (lead - former) / (arrival - start);
      const bool is_off =
          drift * before > 0.0 && std::min(std::abs(drift), std::abs(before)) > kLargestDrift;
      rate = is_off ? 1.0 + drift : kNaN;
      start = arrival;
      former = lead;
    }
    lead = stamp - arrival;
    return rate;
  }
};

}  // namespace handmap
