// The smoothing for Python, and its state.
#pragma once

#include "build_guard.hpp"
#include "handmap/smoothing.hpp"

namespace handmap {

// Of points (n, 3), and of a wrist (4, 4) if there is one.
inline HumanPose make_pose(const Array& points, const std::optional<Array>& wrist) {
  HumanPose pose{points_of(points), wrist.has_value(), {}};
  if (wrist) {
    expect_size(*wrist, 16, "wrist");
    pose.wrist = pose_of(wrist->data());
  }
  return pose;
}

// Numbers of a state, one behind the other.
template <class Visit>
void each_number(SmoothState& state, const Visit& visit) {
  const auto visit_all = [&](std::vector<Vec3>& points) {
    for (Vec3& point : points)
      for (int i = 0; i < 3; ++i) visit(point[i]);
  };
  const auto visit_place = [&](Place& place) {
    visit_all(place.points);
    for (double& number : place.rotation.m) visit(number);
  };
  for (double* number : {&state.noise, &state.waited, &state.dt}) visit(*number);
  visit_place(state.seen);
  for (Place& stage : state.stages) visit_place(stage);
  visit_all(state.moving);
  visit_all(state.speeds);
  for (double& number : state.recent) visit(number);
}

// A `Smoother` for Python.
class PythonSmoother : public Exclusive {
 public:
  Smoother smoother;

  PythonSmoother(std::optional<double> acceleration, double speed_gain) {
    if (acceleration) smoother.options = {*acceleration, speed_gain};
  }

  // Number of points, whether there is a wrist, and all numbers.
  std::tuple<size_t, bool, NumpyArray> save() const {
    SmoothState state = smoother.state;
    Vector numbers;
    each_number(state, [&](double& number) { numbers.push_back(number); });
    return {state.seen.points.size(), state.seen.has_wrist, array_of(numbers)};
  }

  HumanPose smooth(HumanPose pose, double dt) {
    smoother.smooth(pose, dt);
    return pose;
  }
  void wait(double dt) { smoother.wait(dt); }
  void restart() { smoother.restart(); }
  void forget() { smoother.forget(); }

  void restore(const std::tuple<size_t, bool, Array>& saved) {
    SmoothState state;
    const size_t n = std::get<0>(saved);
    const Array& numbers = std::get<2>(saved);
    // Nothing is made of a number of points that the numbers cannot be of.
    expect(n <= numbers.size(), "a state of another core");
    for (Place* place : {&state.seen, &state.stages[0], &state.stages[1], &state.stages[2]}) {
      place->points.resize(n);
      place->has_wrist = std::get<1>(saved);
    }
    state.moving.resize(n > 0 ? n - 1 : 0);
    state.speeds.resize(n > 0 ? n + 1 : 0);
    state.recent.resize(state.speeds.size());
    size_t i = 0;
    each_number(state, [&](double& number) {
      if (i < numbers.size()) number = numbers.data()[i];
      ++i;
    });
    expect(i == numbers.size(), "a state of another core");
    smoother.state = smoother.former = state;
  }
};

}  // namespace handmap
