// Both hands of a person on one robot: see mapping/robot_mapper.py.
#pragma once

#include "mapper.hpp"
#include "handmap/two_palms.hpp"

namespace handmap {

// What one hand of a person asks of a robot; see mapping/hand_request.py.
struct HandRequest {
  std::shared_ptr<const StepReader> reader;
  nb::object python_map;  // the map as Python has it
  HumanPose pose;
  double dt, speed;

  const TargetMap& map() const { return *reader->map; }
  void targets(Targets& targets) const {
    map().targets(pose.points, pose.has_wrist ? &pose.wrist : nullptr, targets);
  }
  NumpyArray rest() const {
    Targets found;
    targets(found);
    return array_of(found.rest);
  }
  nb::object read_targets() const {
    Stages stages;
    stages.reader = reader;
    targets(stages.targets);
    return stages.read_targets();
  }
};

// Makes a `HandRequest` of each sample after a reference, and moves no robot; see
// mapping/target_source.py.
class TargetSource : public SampleReader {
 public:
  // `python_map` is handed on with every `HandRequest`.
  TargetSource(const Ik& ik, std::shared_ptr<const TargetMap> map, StepViews views,
               nb::object python_map)
      : SampleReader(map), python_map_(std::move(python_map)),
        reader_(std::make_shared<StepReader>(
            StepReader{std::move(views), std::move(map), ik.tree.joint_columns})) {
    check_robot(*map_, ik);
  }

 protected:
  // The time of a request is that since the hand's last sample; the robot has a clock of its own.
  nb::object moved(HumanPose&& pose, const When& when, double speed) override {
    check_pose(*map_, pose);
    return nb::cast(HandRequest{reader_, python_map_, std::move(pose), when.own_time(), speed});
  }
  // `RobotFollower` relates the clocks of hands to the robot's.
  double last_time() override { return -HUGE_VAL; }

 private:
  nb::object python_map_;
  std::shared_ptr<const StepReader> reader_;
};

// Moves a robot for the requests of its hands.
class RobotMapper {
 public:
  using Requests = std::vector<const HandRequest*>;

  RobotMapper(std::shared_ptr<Ik> ik, RobotModel model, StepViews views)
      : ik_(std::move(ik)), reader_(std::make_shared<StepReader>(
                                StepReader{std::move(views), nullptr, ik_->tree.joint_columns})),
        model_(std::move(model)), hands_(model_.hands), rest_(ik_->tree.joint_rest) {
    expect_count("RobotModel.hands", hands_.size(), ik_->tree.parts.size());
    const bool has_pinches = model_.has_pinches();
    expect_that(!has_pinches || ik_->pairs, "RobotModel.hands: pinching",
                "none where no links are kept apart");
    for (const RobotHandModel& hand : hands_) {
      expect_that(ik_->tree.has_joint(hand.palm_joint), "RobotModel.hands: palm_joint", "a joint");
      if (has_pinches)
        expect_below("RobotModel.hands: pinching", hand.pinching, ik_->pairs->size());
    }
    if (has_pinches) margins_.assign(ik_->pairs->size(), model_.margin);
  }
  RobotMapper(const RobotMapper&) = delete;

  // Move the robot for a request of each hand. `since` is the time since the reference of each [s].
  // `worlds` are the worlds of these references, seen from the robot's base; none if the base has
  // not moved. Return the stages of the robot, and those of each hand.
  std::pair<nb::object, std::vector<nb::object>> move(const Requests& requests, const Vector& since,
                                                      const std::vector<Pose>& worlds,
                                                      const When& when) {
    expect(requests.size() == hands_.size() && since.size() == hands_.size() &&
               (worlds.empty() || worlds.size() == hands_.size()),
           "wrong number of hands");
    const Work moving(*ik_);
    auto [made, whole] = new_stages(reader_);
    unlocked_.run([&, &to = whole] { seek_requests(requests, since, worlds, when, to); });
    whole.targets.points = whole.result.targets;
    whole.targets.wrist = goal_.wrists[0];
    whole.targets.is_clamped = false;
    whole.pose = {{}, requests[0]->pose.has_wrist, requests[0]->pose.wrist};
    std::vector<nb::object> parts;
    for (size_t k = 0; k < requests.size(); ++k) {
      for (const Vec3& point : requests[k]->pose.points) whole.pose.points.push_back(point);
      whole.targets.is_clamped |= targets_[k].is_clamped;
      parts.push_back(part_of(whole, *requests[k], k));
    }
    return {made, std::move(parts)};
  }

 private:
  // Move towards the requests of the hands; it needs nothing of Python.
  void seek_requests(const Requests& requests, const Vector& since,
                     const std::vector<Pose>& worlds, const When& when, Step& step) {
    double speed = 1.0;
    for (const HandRequest* request : requests) speed = std::min(speed, request->speed);
    aim(requests, since, worlds);
    ik_->set_postures(wanted_rest_, ik_->motion.next(when).granted, goal_.postures);
    goal_.regularise(regularisation_);
    seek(*ik_, goal_, when, margins_, speed, step.result);
    finish(*ik_, step);
  }

  // Set the goal to the requests of the hands.
  void aim(const Requests& requests, const Vector& since, const std::vector<Pose>& worlds) {
    const size_t count = requests.size();
    goal_.points.clear();
    goal_.wrists.clear();
    goal_.distances.clear();
    goal_.offsets.clear();
    wanted_rest_ = rest_;
    regularisation_.assign(rest_.size(), 1.0);
    targets_.resize(count);
    palms_.assign(count, {});
    for (size_t k = 0; k < count; ++k) {
      Targets& targets = targets_[k];
      requests[k]->targets(targets);
      if (targets.points.size() != ik_->tree.parts[k].end - ik_->tree.parts[k].first ||
          targets.rest.size() != rest_.size())
        throw std::invalid_argument("the map is of another hand");
      Pose world;
      if (!worlds.empty()) {
        world = worlds[k];
        move_targets(k, world);
      }
      if (const PalmMap* palm = requests[k]->map().palm()) {
        palms_[k] = {palm, world * palm->person_at(requests[k]->pose.wrist)};
        const double share = smoothstep(since[k] / model_.turns_in);
        move_targets(k, palms_[k].turn(targets_[k].wrist, share));
      }
      for (size_t i = 0; i < rest_.size(); ++i)
        if (ik_->tree.fingers[k][i] != 0.0) {
          wanted_rest_[i] = targets.rest[i];
          if (targets.regularisation) regularisation_[i] = (*targets.regularisation)[i];
        }
      // Others never change.
      for (size_t i = 0; i < hands_[k].pinching.size(); ++i)
        margins_.at(hands_[k].pinching[i]) =
            targets.margins.empty() ? model_.margin : targets.margins.at(hands_[k].among_own[i]);
    }
    if (count == 2 && palms_[0].map && palms_[1].map) bring_together();
    for (const Targets& targets : targets_) {
      goal_.points.insert(goal_.points.end(), targets.points.begin(), targets.points.end());
      goal_.wrists.push_back(targets.wrist);
      if (targets.distances)
        goal_.distances.add().set(*targets.distances, targets.aims, targets.weights);
    }
  }

  void move_targets(size_t k, const Pose& motion) {
    for (Vec3& point : targets_[k].points) point = motion * point;
    targets_[k].wrist = motion * targets_[k].wrist;
  }

  // Move the targets of near palms to where one is seen from the other as the person's is.
  void bring_together() {
    const std::optional<Meeting> meeting =
        meeting_of({palms_[0], palms_[1]}, {targets_[0].wrist, targets_[1].wrist}, model_.near,
                   model_.together);
    if (!meeting) return;
    Attached ends[2];
    for (size_t k = 0; k < 2; ++k) {
      move_targets(k, meeting->motions[k]);
      ends[k] = {hands_[k].palm_joint, hands_[k].palm * palms_[k].map->robot_anchor};
    }
    goal_.offsets.push_back({ends[0], ends[1], meeting->aim,
                             model_.together_share * meeting->share * ik_->weights.wrist_position});
  }

  // The stages of one hand.
  nb::object part_of(const Stages& whole, const HandRequest& request, size_t k) {
    auto [made, stages] = new_stages(request.reader);
    const Part& part = ik_->tree.parts[k];
    const auto own = [&part](const std::vector<Vec3>& of) {
      return std::vector<Vec3>(of.begin() + part.first, of.begin() + part.end);
    };
    const Result& all = whole.result;
    stages.pose = request.pose;
    stages.targets = std::move(targets_[k]);
    stages.targets.points = own(all.targets);
    stages.result = {all.status,       own(all.points),  stages.targets.points, {all.wrists[k]},
                     all.displacement, all.active,       all.iterations,      all.last_step,
                     all.held_by};
    stages.motion = whole.motion;
    stages.q = whole.q;
    return made;
  }

  std::shared_ptr<Ik> ik_;
  std::shared_ptr<const StepReader> reader_;
  const RobotModel model_;
  const std::vector<RobotHandModel>& hands_;
  const Vector rest_;
  Vector margins_;
  // Targets and palm of each hand, and the goal of the QP.
  std::vector<Targets> targets_;
  std::vector<LedPalm> palms_;  // without a map where a method leads none
  Vector wanted_rest_, regularisation_;
  Goal goal_;
  Unlocked unlocked_{0.0};
};

}  // namespace handmap
