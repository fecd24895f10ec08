// What moves a hand as models; see models/ik.py, which says what their fields are.
#pragma once

#include "detours.hpp"
#include "pair_models.hpp"

namespace handmap {

struct IkModel {
  static constexpr const char* kName = "IkModel";
  Vector point_costs;
  double wrist_position_cost = 0.0, wrist_orientation_cost = 0.0;
  double damping = 0.0, error_damping = 0.0;
  double rest_weight = 0.0, speed_weight = 0.0, acceleration_weight = 0.0;
  int max_iterations = 1;
  double step_tolerance = 0.0, point_tolerance = 0.0;
  bool points_follow_wrist = false, takes_detours = false;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("point_costs", point_costs);
    visit("wrist_position_cost", wrist_position_cost);
    visit("wrist_orientation_cost", wrist_orientation_cost);
    visit("damping", damping);
    visit("error_damping", error_damping);
    visit("rest_weight", rest_weight);
    visit("speed_weight", speed_weight);
    visit("acceleration_weight", acceleration_weight);
    visit("max_iterations", max_iterations);
    visit("step_tolerance", step_tolerance);
    visit("point_tolerance", point_tolerance);
    visit("points_follow_wrist", points_follow_wrist);
    visit("takes_detours", takes_detours);
  }
  void check() const {}
};

// Set what a gate of a hand admits. Pairs are kept apart where both of them and how are given.
inline void set_gate(Gate& gate, BoxLimits limits, std::shared_ptr<const PairBounds> bounds,
                     std::optional<CollisionModel> collisions) {
  const size_t nq = static_cast<size_t>(gate.tree.nq), size = static_cast<size_t>(gate.tree.size);
  expect_count("BoxLimits.lowest", limits.lowest.size(), nq);
  expect_count("BoxLimits.lower", limits.lower.size(), size);
  expect_that((bounds != nullptr) == collisions.has_value(), "pairs", "them with a CollisionModel");
  gate.limits = std::move(limits);
  if (bounds) gate.pairs = pairs_of(gate.tree, std::move(bounds), std::move(*collisions));
  gate.motion = {Vector(nq, 0.0), Vector(size, 0.0), 1.0, Vector(size, 0.0), 0.0, new_stamp(), 0};
}

// Set what an `Ik` does with its goals.
inline void set_options(Ik& ik, IkModel model) {
  expect_count("IkModel.point_costs", model.point_costs.size(), ik.tree.points.size());
  ik.weights = {std::move(model.point_costs), model.wrist_position_cost,
                model.wrist_orientation_cost, model.damping, model.error_damping};
  ik.settings = {model.max_iterations, model.step_tolerance, model.point_tolerance,
                 model.rest_weight,    model.speed_weight,   model.acceleration_weight,
                 model.points_follow_wrist};
  ik.takes_detours = model.takes_detours;
  ik.stop_detours();
}

}  // namespace handmap
