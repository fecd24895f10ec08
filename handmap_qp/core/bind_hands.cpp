// Hands as Python sees them: kinematics of points, the nearest posture, pairs of shapes.
#include "bind.hpp"
#include "arrays.hpp"
#include "posture.hpp"

namespace handmap {

using namespace nb::literals;

namespace {

// Postures (k, n) in which the first of k + 1 pads touches each other pad in turn; see
// hand_pair.RobotFingers.pinches. Pads are points on joints, at given distances where they touch.
// `usual` moves the same hand before it was scaled to this tree: its limits and weights hold here too,
// but those of reference points.
NumpyArray pinching_postures(const Tree& tree, const PythonIk& usual, const Indices& joints,
                             const Array& offsets, const Array& distances, double weight, double dt,
                             int samples, double tolerance) {
  DistanceTask task{attached_of(joints, offsets), {}, {}};
  const size_t count = distances.size(), n = tree.q_indices.size();
  expect_size(distances, joints.size() - 1, "distances");
  for (size_t k = 0; k < count; ++k) {
    task.first.push_back(0);
    task.second.push_back(static_cast<int>(k + 1));
  }
  Ik ik(tree);
  ik.weights = usual.weights;
  ik.weights.points.clear();
  ik.settings = usual.settings;
  ik.limits = usual.limits;
  ik.fingers = usual.fingers;
  Vector rest;
  for (const int i : tree.q_indices) rest.push_back(tree.rest[i]);
  double* to;
  NumpyArray postures = array_of({count, n}, to);
  for (size_t k = 0; k < count; ++k) {
    AimedDistances aimed{&task, vector_of(distances), Vector(count, 0.0)};
    aimed.weights[k] = weight;
    ik.motion = {tree.rest, Vector(tree.size, 0.0), 1.0, Vector(tree.size, 0.0)};
    approach(ik, aimed, rest, dt, samples, tolerance);
    for (const int i : tree.q_indices) *to++ = ik.motion.q[i];
  }
  return postures;
}

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
  expect_joints(tree, problem.points);
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

// Points in palm axes, of joint positions (k, n), one posture after the other.
nb::object points_in_palm(const Tree& tree, const Array& q, const std::vector<Attached>& points) {
  const size_t n = tree.q_indices.size();
  if (q.size() % n) throw std::invalid_argument("wrong size of q");
  Placed placed(tree);
  std::vector<Vec3> found;
  for (size_t row = 0; row < q.size(); row += n) {
    placed.place(tree.configuration(q.data() + row).data());
    const Pose from = inverse(placed.pose(tree.palm_origin.joint) * tree.palm);
    for (const Attached& point : points) found.push_back(from * placed.point(point));
  }
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
    const int joint = frame.get<int>("parentJoint") - 1;
    if (!tree.has_joint(joint)) throw std::invalid_argument("a frame of another hand");
    found.push_back(placed.pose(joint) * frame.pose("placement.homogeneous"));
  }
  return array_of(found);
}

// See surface_gaps: of joint positions (T, n), a column for the pairs from each of `starts` on.
nb::object smallest_distances(const Tree& tree, const PairBounds& bounds,
                              const Array& q, const Indices& starts, double most) {
  const size_t n = tree.q_indices.size(), columns = starts.size();
  if (n == 0 || q.size() % n) throw std::invalid_argument("wrong size of q");
  for (size_t g = 0; g < columns; ++g) {
    const int end = g + 1 < columns ? starts[g + 1] : static_cast<int>(bounds.pairs.size());
    if (starts[g] < 0 || starts[g] > end) throw std::invalid_argument("starts must increase");
  }
  for (const Body& body : bounds.bodies)
    if (!tree.has_joint(body.joint)) throw std::invalid_argument("shapes of another hand");
  const size_t rows = q.size() / n;
  Vector found;
  Placed placed(tree);
  SmallestDistances smallest(bounds);
  for (size_t t = 0; t < rows; ++t) {
    placed.place(tree.configuration(q.data() + t * n).data());
    smallest.place(placed);
    for (size_t g = 0; g < columns; ++g) {
      const size_t to = g + 1 < columns ? starts[g + 1] : bounds.pairs.size();
      found.push_back(smallest.among(static_cast<size_t>(starts[g]), to, most));
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
      .def("points",
           [](const Tree& tree, const Array& q, const nb::object& points) {
             return points_in_palm(tree, q, attached_of(tree, points));
           },
           "q"_a, "points"_a)
      .def("points_on_joints",
           [](const Tree& tree, const Array& q, const Indices& joints, const Array& offsets) {
             return points_in_palm(tree, q, attached_of(joints, offsets));
           },
           "q"_a, "joints"_a, "offsets"_a)
      .def("poses", &poses_in)
      .def("nearest_posture", &nearest_posture)
      .def("pinching_postures", &pinching_postures, "usual"_a, "joints"_a, "offsets"_a,
           "distances"_a, "weight"_a, "dt"_a, "samples"_a, "tolerance"_a)
      .def("smallest_distances", &smallest_distances);
  nb::class_<PairBounds>(m, "PairBounds").def("__init__", &make_bounds);
}

}  // namespace handmap
