// The library in C: see handmap/handmap.h. No exception leaves it.
#include "handmap/handmap.h"

#include <atomic>
#include <cmath>
#include <new>
#include <string>

#include "handmap/follower.hpp"
#include "handmap/saved_hand.hpp"

using handmap::Follower;
using handmap::When;

struct handmap_follower {
  Follower follower;
  handmap::Vector velocity;
  std::vector<handmap::Pose> poses;
  std::vector<handmap::Vec3> points;
  std::atomic_flag is_busy = ATOMIC_FLAG_INIT;

  handmap_follower(handmap::FollowerModel model, const handmap::FollowerOptions& options)
      : follower(std::move(model), options), velocity(follower.joint_names.size(), 0.0) {}
};

namespace {

// Kept in place, so that a thread of a control loop takes no memory for it.
constexpr size_t kLongestError = 512;
thread_local char last_error[kLongestError] = "";

handmap_result fail(handmap_result result, const char* problem) {
  std::snprintf(last_error, kLongestError, "%s", problem);
  return result;
}

// Call, and say by a result what it threw.
template <class Call>
handmap_result caught(const Call& call) {
  try {
    call();
    return HANDMAP_OK;
  } catch (const handmap::HandError& error) {
    return fail(HANDMAP_INVALID_HAND, error.what());
  } catch (const handmap::InvalidInput& error) {
    return fail(HANDMAP_INVALID_INPUT, error.what());
  } catch (const std::exception& error) {
    return fail(HANDMAP_FAILED, error.what());
  } catch (...) {
    return fail(HANDMAP_FAILED, "unknown");
  }
}

// The same of work on a hand, at which one thread is at a time.
template <class Call>
handmap_result worked(handmap_follower* hand, const Call& call) {
  if (!hand) return fail(HANDMAP_INVALID_INPUT, "hand: expected one, got NULL");
  if (hand->is_busy.test_and_set(std::memory_order_acquire))
    return fail(HANDMAP_BUSY, "another thread works on the hand");
  const handmap_result result = caught([&] { call(hand->follower); });
  hand->is_busy.clear(std::memory_order_release);
  return result;
}

void expect_given(const void* argument, const char* name) {
  if (!argument) throw handmap::InvalidInput(std::string(name) + ": expected one, got NULL");
}

When after(double dt) {
  if (!(dt > 0.0 && dt < HUGE_VAL)) throw handmap::InvalidInput("dt: expected a time above 0 s");
  return When::after(dt);
}

void write_command(handmap_follower* hand, handmap_command* command) {
  const Follower& follower = hand->follower;
  const handmap::Step& step = follower.step();
  follower.velocities(hand->velocity);
  command->time = follower.time();
  handmap::write_pose(step.result.wrists[0], command->wrist);
  command->q = step.q.data();
  command->velocity = hand->velocity.data();
  command->joints = step.q.size();
  command->status = static_cast<int>(step.result.status);
  command->is_held = follower.is_held();
  command->is_gliding = follower.is_gliding();
  const handmap::Verdict& verdict = follower.verdict();
  command->rule = handmap::kRuleNames[verdict.rule];
  command->mistake = handmap::kMistakes[static_cast<int>(verdict.finding.mistake)].name;
}

// Work on a hand, and write the command.
template <class Call>
handmap_result commanded(handmap_follower* hand, handmap_command* command, const Call& call) {
  return worked(hand, [&](Follower& follower) {
    expect_given(command, "command");
    call(follower);
    write_command(hand, command);
  });
}

const char* name_at(const std::vector<std::string>& names, size_t i) {
  return i < names.size() ? names[i].c_str() : nullptr;
}

handmap::FollowerOptions options_of(const handmap_options& given) {
  handmap::FollowerOptions options;
  if (given.rejoin != HANDMAP_GLIDE && given.rejoin != HANDMAP_CLUTCH)
    throw handmap::InvalidInput("rejoin: expected HANDMAP_GLIDE or HANDMAP_CLUTCH");
  options.palm_fades = given.rejoin == HANDMAP_GLIDE;
  if (!given.smooths) {
    options.smoothing.reset();
    return options;
  }
  if (!(given.acceleration > 0.0 && given.acceleration < HUGE_VAL))
    throw handmap::InvalidInput("acceleration: expected a number above 0 m/s^2");
  if (!(given.speed_gain >= 0.0 && given.speed_gain < HUGE_VAL))
    throw handmap::InvalidInput("speed_gain: expected a number of 0 or more");
  options.smoothing = {given.acceleration, given.speed_gain};
  return options;
}

}  // namespace

extern "C" {

const char* handmap_version(void) { return HANDMAP_VERSION; }

const char* handmap_last_error(void) { return last_error; }

const char* handmap_status_name(int status) {
  const bool is_known = status >= 0 && status < static_cast<int>(std::size(handmap::kStatusNames));
  return is_known ? handmap::kStatusNames[status] : "";
}

handmap_options handmap_default_options(void) {
  const handmap::Smoothing smoothing;
  return {HANDMAP_GLIDE, 1, smoothing.acceleration, smoothing.speed_gain};
}

handmap_sample handmap_new_sample(double time, const double* landmarks) {
  return {time, landmarks, nullptr, 1, 1.0, handmap::kNaN, handmap::kNaN};
}

handmap_result handmap_load(const void* bytes, size_t size, const handmap_options* options,
                            handmap_follower** hand) {
  return caught([&] {
    expect_given(bytes, "bytes");
    expect_given(hand, "hand");
    const handmap::FollowerOptions wanted =
        options_of(options ? *options : handmap_default_options());
    handmap::FollowerModel model =
        handmap::read_saved_hand({static_cast<const char*>(bytes), size});
    try {
      *hand = new handmap_follower(std::move(model), wanted);
    } catch (const std::invalid_argument& error) {
      throw handmap::HandError(error.what());
    }
  });
}

void handmap_free(handmap_follower* hand) { delete hand; }

const char* handmap_name(const handmap_follower* hand) { return hand->follower.name.c_str(); }
const char* handmap_side(const handmap_follower* hand) { return hand->follower.side.c_str(); }
double handmap_usual_dt(const handmap_follower* hand) { return hand->follower.dt; }
size_t handmap_joint_count(const handmap_follower* hand) { return hand->follower.joint_names.size(); }
const char* handmap_joint_name(const handmap_follower* hand, size_t joint) {
  return name_at(hand->follower.joint_names, joint);
}
handmap_result handmap_joint_limits(handmap_follower* hand, double* lower, double* upper,
                                    double* speed) {
  return worked(hand, [&](Follower& follower) {
    for (const double* each : {lower, upper, speed}) expect_given(each, "limits");
    follower.joint_limits(lower, upper, speed);
  });
}
size_t handmap_human_joint_count(const handmap_follower* hand) {
  return hand->follower.human_joint_names.size();
}
const char* handmap_human_joint_name(const handmap_follower* hand, size_t joint) {
  return name_at(hand->follower.human_joint_names, joint);
}

size_t handmap_link_count(const handmap_follower* hand) { return hand->follower.link_names.size(); }
const char* handmap_link_name(const handmap_follower* hand, size_t link) {
  return name_at(hand->follower.link_names, link);
}
handmap_result handmap_link_poses(handmap_follower* hand, double* poses) {
  return worked(hand, [&](Follower& follower) {
    expect_given(poses, "poses");
    follower.link_poses(hand->poses);
    for (size_t i = 0; i < hand->poses.size(); ++i) handmap::write_pose(hand->poses[i], poses + 16 * i);
  });
}

handmap_result handmap_human_landmarks(handmap_follower* hand, const double* human_q,
                                       const double* wrist, double* landmarks) {
  return worked(hand, [&](Follower& follower) {
    expect_given(human_q, "human_q");
    expect_given(wrist, "wrist");
    expect_given(landmarks, "landmarks");
    follower.human_points(human_q, wrist, hand->points);
    for (size_t k = 0; k < hand->points.size(); ++k) {
      double* to = landmarks + 3 * follower.landmarks[k];
      to[0] = hand->points[k].x;
      to[1] = hand->points[k].y;
      to[2] = hand->points[k].z;
    }
  });
}

handmap_result handmap_follow(handmap_follower* hand, const handmap_sample* sample,
                              handmap_command* command) {
  return commanded(hand, command, [&](Follower& follower) {
    expect_given(sample, "sample");
    expect_given(sample->landmarks, "sample.landmarks");
    std::optional<When> when;
    if (!std::isnan(sample->dt)) when = after(sample->dt);
    follower.follow({sample->time, sample->landmarks, sample->wrist, sample->valid != 0,
                     sample->confidence, sample->arrival},
                    when);
  });
}

handmap_result handmap_map_landmarks(handmap_follower* hand, const double* landmarks,
                                     const double* wrist, double dt, handmap_command* command) {
  return commanded(hand, command, [&](Follower& follower) {
    expect_given(landmarks, "landmarks");
    follower.map_landmarks(landmarks, wrist, after(dt));
  });
}

handmap_result handmap_map_joints(handmap_follower* hand, const double* human_q, const double* wrist,
                                  double dt, handmap_command* command) {
  return commanded(hand, command, [&](Follower& follower) {
    expect_given(human_q, "human_q");
    expect_given(wrist, "wrist");
    follower.map_joints(human_q, wrist, after(dt));
  });
}

handmap_result handmap_hold(handmap_follower* hand, double dt, handmap_command* command) {
  return commanded(hand, command, [&](Follower& follower) { follower.hold(after(dt)); });
}

handmap_result handmap_engage(handmap_follower* hand) {
  return worked(hand, [](Follower& follower) { follower.engage(); });
}

handmap_result handmap_disengage(handmap_follower* hand) {
  return worked(hand, [](Follower& follower) { follower.disengage(); });
}

handmap_result handmap_stop(handmap_follower* hand, double dt, handmap_command* command) {
  return commanded(hand, command, [&](Follower& follower) {
    const When when = after(dt);
    follower.disengage();
    follower.hold(when);
  });
}

}  // extern "C"
