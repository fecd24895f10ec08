// Commands of a robot with several hands.
#include <nanobind/stl/optional.h>

#include "bind.hpp"
#include "robot.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

std::vector<Pose> poses_of(const std::optional<Array>& numbers) {
  std::vector<Pose> poses;
  if (!numbers) return poses;
  expect(numbers->size() % 16 == 0, "wrong size of poses");
  for (size_t at = 0; at < numbers->size(); at += 16)
    poses.push_back(pose_of(numbers->data() + at));
  return poses;
}

std::pair<nb::object, std::vector<nb::object>> move(RobotMover& mover, const RobotMover::Asks& asks,
                                                    const Vector& since,
                                                    const std::optional<Array>& worlds,
                                                    const nb::object& when) {
  for (const Ask* ask : asks) expect(ask != nullptr, "a hand that asks nothing");
  return mover.move(asks, since, poses_of(worlds), when_from(when));
}

void make_mover(RobotMover* self, std::shared_ptr<PythonIk> ik, const Vector& rest,
                const Indices& palm_joints, const Array& palms,
                const std::vector<std::pair<Indices, Indices>>& pinching, double turns_in,
                double near, double together, double together_share, double margin,
                StepViews views) {
  const std::vector<Pose> poses = poses_of(palms);
  expect(poses.size() == palm_joints.size() && pinching.size() <= poses.size(), "wrong number of palms");
  std::vector<RobotHand> hands;
  for (size_t k = 0; k < poses.size(); ++k) {
    hands.push_back({palm_joints[k] - 1, poses[k]});
    if (k < pinching.size()) std::tie(hands[k].pinching, hands[k].among_own) = pinching[k];
  }
  new (self) RobotMover(std::move(ik), rest, std::move(hands),
                        {turns_in, near, together, together_share, margin}, std::move(views));
}

}  // namespace

void bind_robot(nb::module_& m) {
  nb::class_<RobotMover>(m, "RobotMover")
      .def("__init__", &make_mover, "ik"_a, "rest"_a, "palm_joints"_a, "palms"_a, "pinching"_a,
           "turns_in"_a, "near"_a, "together"_a, "together_share"_a, "margin"_a, "views"_a)
      .def("__reduce__", &without_copy<RobotMover>)
      .def("move", &move, "asks"_a, "since"_a, "worlds"_a.none(), "when"_a);
}

}  // namespace handmap
