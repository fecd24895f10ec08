// A saved hand that follows a person's: every sample of a tracker is judged, smoothed and mapped to a
// command, or the robot is held. Python has the same for hands whose method is written there; see
// stream/hand_follower.py.
#pragma once

#include "follower_model.hpp"
#include "guard.hpp"
#include "palm_reference.hpp"
#include "rejoin.hpp"

namespace handmap {

// Thrown for a sample that cannot be used. The follower is then as it was before.
struct InvalidInput : std::invalid_argument {
  using std::invalid_argument::invalid_argument;
};

struct FollowerOptions {
  bool palm_fades = true;  // see `Rejoin`
  std::optional<Smoothing> smoothing = Smoothing{};  // none: samples are mapped as they are
};

class Follower {
 public:
  explicit Follower(FollowerModel model, const FollowerOptions& options = {})
      : name(std::move(model.name)), side(model.guard.side), joint_names(std::move(model.joint_names)),
        human_joint_names(std::move(model.human_joint_names)),
        order_names(std::move(model.order_names)), link_names(names_of_links(model.robot)),
        landmarks(model.landmarks.used), dt(model.dt), ik_(tree_of(std::move(model.robot))),
        reader_(std::move(model.landmarks)), joints_(tree_of(std::move(model.human))),
        joint_tolerance_(model.joint_tolerance),
        guard_(sign_of(model.guard.side), landmarks_of(&model.guard.landmarks[0].x),
               make_orders(model.orders)),
        palm_(std::move(model.palm)), teleoperation_(std::move(model.teleoperation)) {
    set_options(ik_, std::move(model.ik));
    std::shared_ptr<const PairBounds> pairs;
    if (model.pairs)
      pairs = std::make_shared<const PairBounds>(bounds_of(std::move(*model.pairs)));
    set_gate(ik_, std::move(model.limits), std::move(pairs), std::move(model.collisions));
    ik_.reserve();
    smoother_.options = options.smoothing;
    return_.palm_fades = options.palm_fades;
    for (Rejoin* each : {&return_, &former_return_}) each->reserve(reader_.size());
    put_at(ik_.tree.joint_rest, {});
    ik_.at.place(ik_.motion.q.data());
    step_.result.wrists = {ik_.at.wrist()};
    finish(ik_, step_);
  }
  Follower(const Follower&) = delete;

  const std::string name, side;
  const std::vector<std::string> joint_names, human_joint_names;
  const std::vector<std::string> order_names;  // of `Finding::which`, where it is of landmarks
  const std::vector<std::string> link_names;   // of the robot
  const Indices landmarks;                     // of the person's, those that it follows
  const double dt;                             // usual time between samples [s]

  // -- what came of the last sample

  const Step& step() const { return step_; }
  // About the last sample that `follow` was given.
  const Verdict& verdict() const { return verdict_; }
  // Whether the robot brakes or stands still instead of following that sample.
  bool is_held() const { return is_held_; }
  // Whether it is on its way back to the person after a hold.
  bool is_gliding() const { return !is_held_ && return_.is_fading(); }
  // Whether the next sample is followed: not after `disengage`.
  bool is_engaged() const { return !is_released_; }
  // Instant of the last command, on the robot's clock [s].
  double time() const { return ik_.motion.time; }

  // Write the velocities of the joints since the command before [rad/s or m/s], in the order of their names.
  void velocities(Vector& to) const {
    const Motion& motion = ik_.motion;
    for (size_t j = 0; j < to.size(); ++j)
      to[j] = motion.displacement[ik_.tree.joint_columns[j]] / motion.dt;
  }

  // Write the limits of the joints: positions [rad or m], and speeds [rad/s or m/s], which may be infinite.
  void joint_limits(double* lower, double* upper, double* speed) const {
    for (size_t j = 0; j < joint_names.size(); ++j) {
      lower[j] = ik_.tree.lower[j];
      upper[j] = ik_.tree.upper[j];
      speed[j] = ik_.limits.speeds[ik_.tree.joint_columns[j]];
    }
  }

  // Write the pose of each link of the robot in its world after the last command.
  void link_poses(std::vector<Pose>& to) {
    ik_.at.place(ik_.motion.q.data());
    to.clear();
    for (const Frame& frame : ik_.tree.frames)
      if (frame.kind == Frame::link) to.push_back(ik_.at.pose(frame.joint) * frame.placement);
  }

  // Write where the person's landmarks are that the hand follows (`landmarks`), for joint angles [rad] and
  // a wrist pose.
  void human_points(const double* q, const double* wrist, std::vector<Vec3>& to) {
    joints_.read(q, checked_pose(wrist), pose_);
    to = pose_.points;
  }

  // -- samples

  // Follow the next sample of a tracker, if it makes sense; else hold. Without `given`, its time stamp
  // says when the command is.
  void follow(const StreamSample& sample, const std::optional<When>& given = {}) {
    if (sample.valid && !is_near(sample.landmarks, 3 * kLandmarks))
      throw InvalidInput("landmarks: expected finite coordinates within 1e9 m");
    std::optional<Pose> wrist;
    StreamSample judged = sample;
    double exact[16];
    if (sample.valid && sample.wrist) {
      wrist = checked_pose(sample.wrist);
      write_pose(*wrist, exact);
      judged.wrist = exact;
    }
    const GuardState former = guard_.state;
    const bool is_new = !map_;
    former_return_ = return_;
    if (is_new) return_.restart();
    const Verdict verdict = guard_.check(judged);
    try {
      take(judged, wrist, verdict, given, is_new);
    } catch (...) {
      guard_.state = former;
      return_ = former_return_;
      throw;
    }
    verdict_ = verdict;
  }

  // Map landmarks (21, 3) [m] without judging or smoothing them; the wrist is fitted where it is null.
  void map_landmarks(const double* landmarks, const double* wrist, const When& when) {
    if (!is_near(landmarks, 3 * kLandmarks))
      throw InvalidInput("landmarks: expected finite coordinates within 1e9 m");
    std::optional<Pose> measured;
    if (wrist) measured = checked_pose(wrist);
    reader_.read(landmarks, measured ? &*measured : nullptr, pose_);
    map(pose_, when, 1.0);
  }

  // Map the person's joint angles [rad] and wrist pose without judging or smoothing them.
  void map_joints(const double* q, const double* wrist, const When& when) {
    for (size_t j = 0; j < joints_.size(); ++j) {
      const double off = joints_.outside(j, q[j]);
      if (!(off <= joint_tolerance_))
        throw InvalidInput("human_q: " + human_joint_names[j] + " is " + std::to_string(q[j]) +
                           " rad, which is " + std::to_string(off) + " outside its limits");
    }
    joints_.read(q, checked_pose(wrist), pose_);
    map(pose_, when, 1.0);
  }

  // Brake, and keep the posture, for one command.
  void hold(const When& when) {
    handmap::hold(ik_, when, step_);
    is_held_ = true;
  }

  // -- between samples

  // Follow from the next sample on, which becomes the reference: the robot continues from where it is.
  void engage() {
    is_released_ = false;
    map_.reset();
  }
  // Brake from the next command on, whatever samples say, until `engage`.
  void disengage() { is_released_ = true; }

 private:
  Ik ik_;
  const LandmarkReader reader_;
  JointReader joints_;
  const double joint_tolerance_;
  StreamGuard guard_;
  Smoother smoother_;
  Rejoin return_, former_return_;  // after the last sample, and before it
  const PalmFollowingModel palm_;
  const TeleoperationModel teleoperation_;
  std::unique_ptr<const TeleoperationMap> map_;  // of the reference; null before it
  bool is_placed_ = false;                       // whether it is known where a floating wrist is
  bool is_released_ = false, is_held_ = true;
  std::optional<double> origin_;  // where the stream's time begins on the robot's clock [s]
  Verdict verdict_{kNothing, true, false, 0.0};
  HumanPose pose_;  // of the sample that is followed
  Step step_;
  Goal goal_;

  static std::vector<std::string> names_of_links(const HandModel& model) {
    std::vector<std::string> names;
    for (const FrameModel& frame : model.frames)
      if (frame.kind == "link") names.push_back(frame.name);
    return names;
  }

  static Pose checked_pose(const double* matrix) {
    const std::optional<Pose> pose = tracked_pose(matrix);
    if (!pose)
      throw InvalidInput("wrist_pose: expected a pose (4, 4): finite, a rotation within 1e-3, and a "
                         "last row of 0, 0, 0, 1");
    return *pose;
  }

  // Put the robot at joint positions, at rest; its clock goes on.
  void put_at(const Vector& q, const Pose& wrist) {
    Motion motion = ik_.motion;
    const Tree& tree = ik_.tree;
    motion.q = tree.configuration(q.data());
    if (tree.is_floating) {
      const Pose root = wrist * inverse(tree.wrist);
      const Quat turn = quat_of(root.R);
      const double sign = turn.w < 0.0 ? -1.0 : 1.0;
      const double at[7] = {root.p.x,      root.p.y,      root.p.z,     sign * turn.x,
                            sign * turn.y, sign * turn.z, sign * turn.w};
      std::copy(at, at + 7, motion.q.begin());
    }
    motion.displacement.assign(tree.size, 0.0);
    motion.stop_times.assign(tree.size, 0.0);
    motion.dt = 1.0;
    motion.stamp = new_stamp();
    ik_.set_motion(motion);
    is_placed_ = !tree.is_floating;
  }

  // Map or hold a sample that was judged.
  void take(const StreamSample& sample, const std::optional<Pose>& wrist, const Verdict& verdict,
            const std::optional<When>& given, bool is_new) {
    const double granted = given ? given->own_time() : std::max(verdict.dt, kShortestDt);
    // The stream is not on the robot's clock before its first command.
    const When when = given     ? *given
                      : origin_ ? When::at(*origin_ + verdict.time, granted)
                                : When::after(granted);
    if (verdict.is_held) {
      smoother_.wait(granted);
      hold(when);
    } else {
      reader_.read(sample.landmarks, wrist ? &*wrist : nullptr, pose_);
      if (verdict.is_return) {
        return_.start(pose_, verdict.lost);
        smoother_.restart();
      }
      return_.advance(pose_, verdict.dt);
      if (is_new) smoother_.restart();
      smoother_.smooth(pose_, granted);
      try {
        map(pose_, when, verdict.rule == kUnproven ? kUnprovenSpeed : 1.0);
      } catch (...) {
        smoother_.forget();
        throw;
      }
      return_.seen = pose_;
      return_.has_seen = true;
    }
    note_origin(verdict, given.has_value());
  }

  // Note where the stream's time begins, after the command for a sample. Time stamps count from the next
  // one where the caller gave the time of this one.
  void note_origin(const Verdict& verdict, bool is_given) {
    if (is_given) {
      origin_.reset();
      return;
    }
    // Holds between samples may have taken more time than the stream's clock.
    const double origin = ik_.motion.time - verdict.time;
    if (!origin_ || origin - *origin_ > kBehind) origin_ = origin;
  }

  // Map a sample to a command; the first one is the reference.
  void map(const HumanPose& pose, const When& when, double speed) {
    if (is_released_) {
      hold(when);
      return;
    }
    if (!map_) refer_to(pose);
    handmap::follow(ik_, *map_, pose, when, speed, goal_, step_);
    is_held_ = false;
  }

  // Count motion from a sample. A robot without a place is put with its palm on the person's.
  void refer_to(const HumanPose& pose) {
    if (!is_placed_) {
      const Pose wrist =
          start_palm(palm_, pose.wrist) * inverse(palm_.robot_wrist_to_palm);
      put_at(joints_now(), wrist);
      is_placed_ = true;
    }
    ik_.at.place(ik_.motion.q.data());
    map_ = std::make_unique<const TeleoperationMap>(
        teleoperation_, PalmMap{palm_at(palm_, pose.wrist, ik_.at.wrist())});
  }

  Vector joints_now() const {
    Vector q;
    for (const int i : ik_.tree.q_indices) q.push_back(ik_.motion.q[i]);
    return q;
  }
};

}  // namespace handmap
