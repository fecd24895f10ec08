// Hands as Python sees them: kinematics of points, the nearest posture, pairs of shapes.
#include "bind.hpp"
#include "arrays.hpp"
#include "posture.hpp"

namespace handmap {
namespace {

// See ik.nearest_posture, whose constants and arguments these are.
nb::object nearest_posture(const Tree& tree, const nb::object& hand, const Array& targets,
                           const Array& costs, double rest_cost, const Array& start) {
  const Fields constants = module_of("ik.nearest_posture");
  const Fields of(hand);
  NearestPosture problem(tree);
  problem.settings = {constants.get<int>("_MOST_STEPS"), constants.get<double>("_SMALLEST_STEP"),
                      constants.get<double>("_LEAST_DECREASE"),
                      constants.get<double>("_SMALLEST_SHARE"), constants.get<double>("_ROUNDING"),
                      constants.get<double>("_LEAST_CURVATURE")};
  problem.points = reference_points(of);
  const size_t n = tree.joint_columns.size(), m = problem.points.size();
  problem.configuration = tree.rest;
  problem.rest = vector_of(of.array("rest", n));
  problem.lower = vector_of(of.array("lower_limits", n));
  problem.upper = vector_of(of.array("upper_limits", n));
  expect_size(targets, 3 * m, "targets");
  expect_size(costs, m, "costs");
  expect_size(start, n, "start");
  problem.targets = points_of(targets);
  problem.costs = vector_of(costs);
  for (double& cost : problem.costs) cost *= cost;
  problem.rest_cost = rest_cost * rest_cost;
  return nb::cast(array_of(problem.solve(vector_of(start))));
}

// Points by `PointSpec` in palm axes, of joint positions.
nb::object points_in_palm(const Tree& tree, const Array& q, const nb::object& points) {
  expect_size(q, tree.q_indices.size(), "q");
  Placed placed(tree);
  placed.place(tree.configuration(q.data()).data());
  const Pose from = inverse(placed.pose(tree.palm_origin.joint) * tree.palm);
  std::vector<Vec3> found;
  for (const Attached& point : attached_of(tree, points))
    found.push_back(from * placed.point(point));
  return array_of(found);
}

// Poses of frames of Pinocchio in a configuration.
nb::object poses_in(const Tree& tree, const Array& q, const nb::object& frames) {
  expect_size(q, tree.nq, "q");
  Placed placed(tree);
  placed.place(q.data());
  std::vector<Pose> found;
  for (const nb::handle& each : frames) {
    const Fields frame(nb::borrow(each));
    found.push_back(placed.pose(frame.get<int>("parentJoint") - 1) *
                    frame.pose("placement.homogeneous"));
  }
  return array_of(found);
}

// See surface_gaps: of joint positions (T, n), a column for the pairs from each of `starts` on.
nb::object smallest_distances(const Tree& tree, const PairBounds& bounds,
                              const Array& q, const Indices& starts, double most) {
  const size_t n = tree.q_indices.size(), rows = q.size() / n, columns = starts.size();
  Vector found;
  Placed placed(tree);
  SmallestDistances smallest(bounds);
  for (size_t t = 0; t < rows; ++t) {
    placed.place(tree.configuration(q.data() + t * n).data());
    smallest.place(placed);
    for (size_t g = 0; g < columns; ++g) {
      const size_t to = g + 1 < columns ? starts[g + 1] : bounds.pairs.size();
      found.push_back(smallest.among(starts[g], to, most));
    }
  }
  return array_of({rows, columns}, found.data());
}

}  // namespace

void bind_hands(nb::module_& m) {
  nb::class_<Tree>(m, "Tree")
      .def("__init__",
           [](Tree* self, const nb::object& hand) {
             make_frames(*new (self) Tree(make_tree(Fields(hand))), Fields(hand));
           })
      .def("moved", &moved_tree)
      .def("points", &points_in_palm)
      .def("poses", &poses_in)
      .def("nearest_posture", &nearest_posture)
      .def("smallest_distances", &smallest_distances);
  nb::class_<PairBounds>(m, "PairBounds").def("__init__", &make_bounds);
}

}  // namespace handmap
