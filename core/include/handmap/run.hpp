// Samples of a recording, one after the other: see stream/follower.py.
#pragma once

#include <time.h>

#include "guard.hpp"
#include "smoothing.hpp"

namespace handmap {

// Numbers of a row; see stream.step_table.StepTable.
inline size_t row_width(const Ik& ik) {
  return 2 * ik.tree.q_indices.size() + 32 + 6 * ik.tree.points.size() + 6;
}

// CPU time of this thread [s].
inline double thread_time() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

struct Run {
  Ik& ik;
  const TargetMap& map;
  const LandmarkReader& reader;
  StreamGuard& guard;
  Smoother& smoother;
  double origin;  // where the stream's time begins on the robot's clock [s]

  Verdict verdict{};
  GuardState former = guard.state;  // before the last sample
  bool leaves = false;  // whether the last sample was judged, and is left to Python
  size_t count = 0;     // samples that moved the hand, or held it
  Step step{};
  bool has_seen = false;
  HumanPose seen{};  // the last one that was mapped
  HumanPose pose{};  // of the sample
  Goal goal{};

  // Map a sample into a row; false for one that Python has to look at.
  bool take(const StreamSample& sample, double* row) {
    const double started = thread_time();
    std::optional<Pose> wrist;
    if (sample.valid && !is_near(sample.landmarks, 3 * kLandmarks)) return false;
    if (sample.wrist && sample.valid && !(wrist = exact_pose(sample.wrist))) return false;
    former = guard.state;
    verdict = guard.check(sample);
    // Python leads back to the hand after a hold, and relates the stream's clock to the robot's.
    const double behind = ik.motion.time - (origin + verdict.time);
    leaves = verdict.is_return || behind > kBehind;
    if (leaves) return false;
    try {
      move(sample, wrist);
    } catch (...) {
      guard.state = former;
      throw;
    }
    ++count;
    write(sample, started, row);
    return true;
  }

 private:
  void move(const StreamSample& sample, const std::optional<Pose>& wrist) {
    const double dt = std::max(verdict.dt, kShortestDt);
    const When when = When::at(origin + verdict.time, dt);
    if (verdict.is_held) {
      smoother.wait(dt);
      hold(ik, when, step);
      return;
    }
    reader.read(sample.landmarks, wrist ? &*wrist : nullptr, pose);
    smoother.smooth(pose, dt);
    const double speed = verdict.rule == kUnproven ? kUnprovenSpeed : 1.0;
    try {
      follow(ik, map, pose, when, speed, goal, step);
    } catch (...) {
      smoother.forget();
      throw;
    }
    seen = pose;
    has_seen = true;
  }

  void write(const StreamSample& sample, double started, double* to) const {
    constexpr double kHeld = static_cast<double>(Status::released) + 1.0;
    const Result& result = step.result;
    Vector numbers = step.q;
    append(result.wrists[0], numbers);
    append(step.targets.wrist, numbers);
    append(step.targets.points, numbers);
    append(result.points, numbers);
    for (const int column : ik.tree.joint_columns) numbers.push_back(result.active[column] != 0);
    to = std::copy(numbers.begin(), numbers.end(), to);
    *to++ = verdict.is_held ? kHeld : static_cast<double>(result.status);
    *to++ = verdict.rule;
    *to++ = verdict.is_held;
    *to++ = verdict.consistency;
    *to++ = sample.confidence;
    *to++ = thread_time() - started;
  }
};

}  // namespace handmap
