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

std::pair<nb::object, std::vector<nb::object>> move(RobotMapper& mapper,
                                                    const RobotMapper::Requests& requests,
                                                    const Vector& since,
                                                    const std::optional<Array>& worlds,
                                                    const nb::object& when) {
  for (const HandRequest* request : requests)
    expect(request != nullptr, "a hand without a request");
  return mapper.move(requests, since, poses_of(worlds), when_from(when));
}

}  // namespace

void bind_robot(nb::module_& m) {
  nb::class_<RobotMapper>(m, "RobotMapper")
      .def("__init__",
           [](RobotMapper* self, std::shared_ptr<Ik> ik, const nb::bytes& model,
              StepViews views) {
             new (self) RobotMapper(std::move(ik), model_of<RobotModel>(model), std::move(views));
           },
           "ik"_a, "model"_a, "views"_a)
      .def("__reduce__", &without_copy<RobotMapper>)
      .def("move", &move, "requests"_a, "since"_a, "worlds"_a.none(), "when"_a);
}

}  // namespace handmap
