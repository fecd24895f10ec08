// Both hands of a person on one robot: see mapping/robot_mapper.py, whose names these are.
#pragma once

#include "mapper.hpp"
#include "handmap/robot_model.hpp"

namespace handmap {

// What a hand of a person asks of a robot; see mapper.Asked.
struct Ask {
  std::shared_ptr<const StepReader> reader;
  nb::object source;  // what Python has in the place of the map
  HumanPose pose;
  double dt, speed;

  const TargetMap& map() const { return *reader->map; }
  void targets(Asked& asked) const {
    map().targets(pose.points, pose.has_wrist ? &pose.wrist : nullptr, asked);
  }
  nb::object read_targets() const {
    Stages stages;
    stages.reader = reader;
    targets(stages.asked);
    return stages.read_asked();
  }
};

// Lets a `Leader` ask with each sample after its reference.
class Asker : public SampleReader {
 public:
  // `source` is handed on with every `Ask`.
  Asker(const Ik& ik, std::shared_ptr<const TargetMap> map, StepViews views, nb::object source)
      : SampleReader(map), source_(std::move(source)),
        reader_(std::make_shared<StepReader>(
            StepReader{std::move(views), std::move(map), ik.tree.joint_columns})) {
    check_robot(*map_, ik);
  }

 protected:
  // A hand asks by the time since its own last sample; the robot has a clock of its own.
  nb::object moved(HumanPose&& pose, const When& when, double speed) override {
    check_pose(*map_, pose);
    return nb::cast(Ask{reader_, source_, std::move(pose), when.own_time(), speed});
  }
  // `RobotFollower` relates the clocks of hands to the robot's.
  double last_time() override { return -HUGE_VAL; }

 private:
  nb::object source_;
  std::shared_ptr<const StepReader> reader_;
};

// The motion that turns a palm about its anchor to another one's axes.
inline Pose turned(const Pose& palm, const Vec3& anchor, const Pose& to, double share) {
  const Vec3 centre = palm * anchor;
  const Mat3 turn = exp3(share * log3(to.R * transposed(palm.R)));
  return {turn, centre - turn * centre};
}

// Moves a robot for what its hands ask.
class RobotMover {
 public:
  using Asks = std::vector<const Ask*>;

  RobotMover(std::shared_ptr<Ik> ik, RobotModel model, StepViews views)
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
  RobotMover(const RobotMover&) = delete;

  // Move the robot for what its hands ask, so long after their references [s], whose worlds are where
  // the robot is seen from; no worlds if its base has not moved. Return the stages of the robot, and
  // those of each hand.
  std::pair<nb::object, std::vector<nb::object>> move(const Asks& asks, const Vector& since,
                                                      const std::vector<Pose>& worlds,
                                                      const When& when) {
    expect(asks.size() == hands_.size() && since.size() == hands_.size() &&
               (worlds.empty() || worlds.size() == hands_.size()),
           "wrong number of hands");
    const Work moving(*ik_);
    double speed = 1.0;
    for (const Ask* ask : asks) speed = std::min(speed, ask->speed);
    aim(asks, since, worlds);
    goal_.postures = ik_->postures(wanted_rest_, ik_->motion.next(when).granted);
    goal_.regularise(regularisation_);
    auto [made, whole] = new_stages(reader_);
    seek(*ik_, goal_, when, margins_, speed, whole.result);
    finish(*ik_, whole);
    whole.asked.points = whole.result.targets;
    whole.asked.wrist = goal_.wrists[0];
    whole.pose = {{}, asks[0]->pose.has_wrist, asks[0]->pose.wrist};
    std::vector<nb::object> parts;
    for (size_t k = 0; k < asks.size(); ++k) {
      for (const Vec3& point : asks[k]->pose.points) whole.pose.points.push_back(point);
      whole.asked.is_clamped |= asked_[k].is_clamped;
      parts.push_back(part_of(whole, *asks[k], k));
    }
    return {made, std::move(parts)};
  }

 private:
  // Set the goal to what the hands ask.
  void aim(const Asks& asks, const Vector& since, const std::vector<Pose>& worlds) {
    const size_t count = asks.size();
    goal_.points.clear();
    goal_.wrists.clear();
    goal_.distances.clear();
    goal_.offsets.clear();
    wanted_rest_ = rest_;
    regularisation_.assign(rest_.size(), 1.0);
    asked_.resize(count);
    persons_.resize(count);
    for (size_t k = 0; k < count; ++k) {
      Asked& asked = asked_[k];
      asks[k]->targets(asked);
      if (asked.points.size() != ik_->tree.parts[k].end - ik_->tree.parts[k].first ||
          asks[k]->map().rest.size() != rest_.size())
        throw std::invalid_argument("the map is of another hand");
      Pose world;
      if (!worlds.empty()) {
        world = worlds[k];
        move_targets(k, world);
      }
      if (const PalmMap* palm = asks[k]->map().palm()) {
        persons_[k] = world * palm->person_at(asks[k]->pose.wrist);
        turn(*palm, k, smoothstep(since[k] / model_.turns_in));
      }
      for (size_t i = 0; i < rest_.size(); ++i)
        if (ik_->tree.fingers[k][i] != 0.0) {
          wanted_rest_[i] = asks[k]->map().rest[i];
          if (asked.regularisation) regularisation_[i] = (*asked.regularisation)[i];
        }
      // Others never change.
      for (size_t i = 0; i < hands_[k].pinching.size(); ++i)
        margins_.at(hands_[k].pinching[i]) =
            asked.margins.empty() ? model_.margin : asked.margins.at(hands_[k].among_own[i]);
    }
    if (count == 2) bring_together(asks);
    for (const Asked& asked : asked_) {
      goal_.points.insert(goal_.points.end(), asked.points.begin(), asked.points.end());
      goal_.wrists.push_back(asked.wrist);
      if (asked.distances)
        goal_.distances.push_back({asked.distances, asked.aims, asked.weights});
    }
  }

  // The target of a palm.
  Pose palm_of(const PalmMap& map, size_t k) const {
    return asked_[k].wrist * inverse(map.robot_palm_to_wrist);
  }

  void move_targets(size_t k, const Pose& motion) {
    for (Vec3& point : asked_[k].points) point = motion * point;
    asked_[k].wrist = motion * asked_[k].wrist;
  }

  // Turn targets about a palm's anchor to the person's axes, and shift them.
  void turn(const PalmMap& map, size_t k, double share, const Vec3& shift = {}) {
    Pose motion = turned(palm_of(map, k), map.robot_anchor, persons_[k], share);
    motion.p += shift;
    move_targets(k, motion);
  }

  // Move the targets of near palms to where one is seen from the other as the person's is.
  void bring_together(const Asks& asks) {
    const PalmMap *first = asks[0]->map().palm(), *other = asks[1]->map().palm();
    if (!first || !other) return;
    const Vec3 apart = persons_[1].p - persons_[0].p;
    const double gap = norm(apart) / (1.0 + first->further);
    const double share = smoothstep((model_.near - gap) / (model_.near - model_.together));
    if (share == 0.0 || !std::equal(first->alignment.m, first->alignment.m + 9, other->alignment.m))
      return;
    const Vec3 own =
        palm_of(*other, 1) * other->robot_anchor - palm_of(*first, 0) * first->robot_anchor;
    const Vec3 aim = own + share * (apart - own);
    turn(*first, 0, share, -0.5 * (aim - own));
    turn(*other, 1, share, 0.5 * (aim - own));
    goal_.offsets.push_back({{hands_[0].palm_joint, hands_[0].palm * first->robot_anchor},
                             {hands_[1].palm_joint, hands_[1].palm * other->robot_anchor},
                             aim,
                             model_.together_share * share * ik_->weights.wrist_position});
  }

  // The stages of one hand.
  nb::object part_of(const Stages& whole, const Ask& ask, size_t k) {
    auto [made, stages] = new_stages(ask.reader);
    const Part& part = ik_->tree.parts[k];
    const auto own = [&part](const std::vector<Vec3>& of) {
      return std::vector<Vec3>(of.begin() + part.first, of.begin() + part.end);
    };
    const Result& all = whole.result;
    stages.pose = ask.pose;
    stages.asked = std::move(asked_[k]);
    stages.asked.points = own(all.targets);
    stages.result = {all.status,       own(all.points),  stages.asked.points, {all.wrists[k]},
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
  // What the hands ask, where the person's palms are in the robot's world, and what the QP is to do.
  std::vector<Asked> asked_;
  std::vector<Pose> persons_;
  Vector wanted_rest_, regularisation_;
  Goal goal_;
};

}  // namespace handmap
