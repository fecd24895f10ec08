// Both hands of a person on one robot: see mapping/robot_mapper.py, whose names these are.
#pragma once

#include "mapper.hpp"

namespace handmap {

// What a hand of a person asks of a robot; see robot_mapper.Asked.
struct Ask {
  nb::object target_map;  // of Python
  const TargetMap* map;
  std::shared_ptr<const StepReader> reader;
  HumanPose pose;
  double dt, speed;

  void targets(Asked& asked) const {
    map->targets(pose.points, pose.has_wrist ? &pose.wrist : nullptr, asked);
  }
  nb::object rest() const { return nb::getattr(target_map, "rest"); }
  nb::object read_targets() const {
    Asked asked;
    targets(asked);
    return reader->targets(parts_of(asked, reader->shapes), asked.is_clamped);
  }
};

// A copy, by copy or pickle, is one of Python.
inline nb::tuple reduced_ask(const nb::object& self) {
  const nb::object kind = module_of("mapping.robot_mapper").object("Asked");
  nb::list parts;
  for (const char* name : {"pose", "targets", "rest", "dt", "speed", "map"})
    parts.append(nb::getattr(self, name));
  return nb::make_tuple(kind, nb::tuple(parts));
}

// Lets a `Leader` ask with each sample after its reference.
class Asker : public SampleReader {
 public:
  // Of the core's `Ik` of a robot, a hand of it, and a map of Python with a core.
  Asker(const PythonIk& ik, const nb::object& hand, const nb::object& target_map)
      : SampleReader(target_map), reader_(reader_of(target_map, hand, ik.links)) {}

 protected:
  // A hand asks by the time since its own last sample; the robot has a clock of its own.
  nb::object moved(HumanPose&& pose, const When& when, double speed) override {
    if (pose.points.size() != map_.human_points || (map_.needs_wrist && !pose.has_wrist))
      throw std::invalid_argument("the map is of another hand");
    return nb::cast(Ask{map_owner_, &map_, reader_, std::move(pose), when.own_time(), speed});
  }
  // `RobotFollower` relates the clocks of hands to the robot's.
  double last_time() override { return -HUGE_VAL; }

 private:
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
  // Of a core's `Ik`, the robot as one hand, the pairs of each hand that pinch, the leaders by side,
  // and the time in which palms turn.
  RobotMover(nb::object ik, const nb::object& robot, const nb::list& pinching, nb::dict leaders,
             double turns_in)
      : ik_owner_(std::move(ik)), ik_(nb::cast<PythonIk&>(ik_owner_)),
        rest_(Fields(robot).numbers("rest")), leaders_(std::move(leaders)), turns_in_(turns_in) {
    const Fields constants = module_of("mapping.robot_mapper");
    reader_ = std::make_shared<StepReader>(robot, ik_.links, nb::none());
    home_ = constants.object("_HOME");
    map_step_ = constants.object("MapStep");
    robot_step_ = constants.object("RobotStep");
    near_ = constants.get<double>("_NEAR");
    together_ = constants.get<double>("_TOGETHER");
    together_share_ = constants.get<double>("_TOGETHER_SHARE");
    for (const nb::handle& each : nb::getattr(robot, "hands")) {
      const Fields hand(nb::borrow(each));
      const Fields palm(hand.object("palm_frame"));
      hands_.push_back({palm.get<int>("parentJoint") - 1, palm.pose("placement.homogeneous")});
    }
    expect(pinching.size() <= hands_.size() && hands_.size() <= ik_.tree.parts.size() &&
               (pinching.size() == 0 || ik_.pairs) &&
               rest_.size() == ik_.tree.joint_columns.size(),
           "a robot of other hands");
    for (const RobotHand& hand : hands_)
      expect(ik_.tree.has_joint(hand.palm_joint), "a palm of another robot");
    for (size_t k = 0; k < pinching.size(); ++k) {
      hands_[k].pinching = indices_of(nb::borrow(pinching[k])[nb::int_(0)]);
      hands_[k].among_own = indices_of(nb::borrow(pinching[k])[nb::int_(1)]);
    }
    margin_ = module_of("hands").get<double>("LINK_MARGIN");
    if (pinching.size() > 0) margins_.assign(ik_.pairs->size(), margin_);
  }
  RobotMover(const RobotMover&) = delete;

  // Map a sample of every hand as they come in, by the readers that leaders have under a name; None
  // for samples that Python has to look at. `when` and `base` are those of `move`.
  nb::object map(const nb::str& reader, const nb::object& given, const nb::object& given_wrists,
                 const nb::object& given_when, const nb::object& base) {
    static const nb::object &core = interned("core"), &map = interned("map"),
                            &waited = interned("waited"), &last = interned("last"),
                            &since = interned("since"), &stages = interned("stages");
    const Clock::time_point started = Clock::now();
    nb::dict numbers, wrists;
    const std::optional<When> when = plain_when(given_when);
    if (!when || !nb::try_cast(given, numbers) || !nb::try_cast(given_wrists, wrists) ||
        numbers.size() != leaders_.size())
      return nb::none();
    const double granted = ik_.motion.next(*when).granted;
    std::vector<nb::object> steps;
    std::vector<const Ask*> asks;
    for (const auto [side, leader] : leaders_) {
      const nb::object asker = nb::getattr(leader, core);
      if (asker.is_none() || !numbers.contains(side)) return nb::none();
      // One that has stayed, or is a copy, asks in Python.
      const nb::object before = nb::getattr(nb::getattr(leader, last), stages);
      if (!nb::isinstance<Ask>(before)) return nb::none();
      const nb::object wrist = wrists.contains(side) ? nb::object(wrists[side]) : nb::none();
      const double own = nb::cast<double>(nb::getattr(leader, waited)) + granted;
      steps.push_back(nb::getattr(asker, map)(nb::getattr(nb::getattr(leader, reader), core),
                                              numbers[side], wrist, own));
      if (steps.back().is_none()) return nb::none();
      asks.push_back(nb::cast<const Ask*>(nb::getattr(steps.back(), stages)));
    }
    Vector times;
    for (const auto [side, leader] : leaders_) {
      const double own = asks[times.size()]->dt;
      times.push_back(nb::cast<double>(nb::getattr(leader, since)) + own);
    }
    const auto [whole, parts] = moved(asks, times, worlds_from(base), *when);
    const double duration = std::chrono::duration<double>(Clock::now() - started).count();
    nb::dict hands;
    size_t k = 0;
    for (const auto [side, leader] : leaders_) {
      nb::setattr(leader, last, steps[k]);
      nb::setattr(leader, since, nb::float_(times[k]));
      nb::setattr(leader, waited, nb::float_(0.0));
      hands[side] = map_step_(parts[k++], nb::tuple(), duration);
    }
    return robot_step_(whole, nb::tuple(), duration, nb::arg("hands") = hands);
  }

  // Move the robot for what its leaders have asked last, with its base at a pose. Return the stages of
  // the robot, and those of each hand; None if one has asked in Python.
  nb::object move(const nb::object& base, const nb::object& when) {
    static const nb::object &last = interned("last"), &since = interned("since"),
                            &stages = interned("stages");
    std::vector<nb::object> owners;
    std::vector<const Ask*> asks;
    Vector times;
    for (const auto [side, leader] : leaders_) {
      owners.push_back(nb::getattr(nb::getattr(leader, last), stages));
      if (!nb::isinstance<Ask>(owners.back())) return nb::none();
      asks.push_back(nb::cast<const Ask*>(owners.back()));
      times.push_back(nb::cast<double>(nb::getattr(leader, since)));
    }
    const auto [whole, parts] = moved(asks, times, worlds_from(base), when_from(when));
    nb::list of_hands;
    for (const nb::object& part : parts) of_hands.append(part);
    return nb::make_tuple(whole, of_hands);
  }

 private:
  using Clock = std::chrono::steady_clock;

  // Where the world of each reference is from a base; nothing if that has not moved.
  std::vector<Pose> worlds_from(const nb::object& base) const {
    if (base.is(home_)) return {};
    const auto pose_at = [](const nb::object& from) { return Fields(from).pose(""); };
    const Pose to_base = inverse(pose_at(base));
    std::vector<Pose> worlds;
    for (const auto [side, leader] : leaders_)
      worlds.push_back(to_base * pose_at(nb::getattr(leader, "base")));
    return worlds;
  }

  struct RobotHand {
    int palm_joint;
    Pose palm;  // on that joint
    Indices pinching = {}, among_own = {};
  };

  using Moved = std::pair<nb::object, std::vector<nb::object>>;
  Moved moved(const std::vector<const Ask*>& asks, const Vector& times,
              const std::vector<Pose>& worlds, const When& when) {
    if (asks.size() != hands_.size() || times.size() != hands_.size() ||
        (!worlds.empty() && worlds.size() != hands_.size()))
      throw std::invalid_argument("wrong number of hands");
    double speed = 1.0;
    for (const Ask* ask : asks) speed = std::min(speed, ask->speed);
    const Work moving(ik_);
    aim(asks, times, worlds);
    goal_.postures = ik_.postures(wanted_rest_, ik_.motion.next(when).granted);
    goal_.regularise(regularisation_);
    auto [made, whole] = new_stages(reader_);
    seek(ik_, goal_, when, margins_, speed, whole.result);
    finish(ik_, whole);
    whole.asked.points = whole.result.targets;
    whole.asked.wrist = goal_.wrists[0];
    whole.pose = {{}, asks[0]->pose.has_wrist, asks[0]->pose.wrist};
    std::vector<nb::object> parts;
    for (size_t k = 0; k < asks.size(); ++k) {
      for (const Vec3& point : asks[k]->pose.points) whole.pose.points.push_back(point);
      whole.asked.is_clamped |= asked_[k].is_clamped;
      parts.push_back(part_of(whole, *asks[k], k));
    }
    return {made, parts};
  }

  static Indices indices_of(const nb::handle& array) {
    return nb::cast<Indices>(nb::getattr(array, "tolist")());
  }

  // Set the goal to what the hands ask.
  void aim(const std::vector<const Ask*>& asks, const Vector& times,
           const std::vector<Pose>& worlds) {
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
      if (asked.points.size() != ik_.tree.parts[k].end - ik_.tree.parts[k].first ||
          asks[k]->map->rest.size() != rest_.size())
        throw std::invalid_argument("the map is of another hand");
      Pose world;
      if (!worlds.empty()) {
        world = worlds[k];
        move_targets(k, world);
      }
      if (const PalmMap* palm = asks[k]->map->palm()) {
        persons_[k] = world * palm->person_at(asks[k]->pose.wrist);
        turn(*palm, k, smoothstep(times[k] / turns_in_));
      }
      for (size_t i = 0; i < rest_.size(); ++i)
        if (ik_.tree.fingers[k][i] != 0.0) {
          wanted_rest_[i] = asks[k]->map->rest[i];
          if (asked.regularisation) regularisation_[i] = (*asked.regularisation)[i];
        }
      // Others never change.
      for (size_t i = 0; i < hands_[k].pinching.size(); ++i)
        margins_.at(hands_[k].pinching[i]) =
            asked.margins.empty() ? margin_ : asked.margins.at(hands_[k].among_own[i]);
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
  void bring_together(const std::vector<const Ask*>& asks) {
    const PalmMap *first = asks[0]->map->palm(), *other = asks[1]->map->palm();
    if (!first || !other) return;
    const Vec3 apart = persons_[1].p - persons_[0].p;
    const double gap = norm(apart) / (1.0 + first->further);
    const double share = smoothstep((near_ - gap) / (near_ - together_));
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
                             together_share_ * share * ik_.weights.wrist_position});
  }

  // The stages of one hand.
  nb::object part_of(const Stages& whole, const Ask& ask, size_t k) {
    auto [made, stages] = new_stages(ask.reader);
    const Part& part = ik_.tree.parts[k];
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

  nb::object ik_owner_, map_step_, robot_step_, home_;
  PythonIk& ik_;
  std::shared_ptr<const StepReader> reader_;
  Vector rest_, margins_;
  const nb::dict leaders_;
  double turns_in_, near_, together_, together_share_, margin_;
  std::vector<RobotHand> hands_;
  // What the hands ask, where the person's palms are in the robot's world, and what the QP is to do.
  std::vector<Asked> asked_;
  std::vector<Pose> persons_;
  Vector wanted_rest_, regularisation_;
  Goal goal_;
};

}  // namespace handmap
