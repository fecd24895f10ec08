// Hands as Python sees them: kinematics of points, the nearest posture, pairs of shapes.
#include "bind.hpp"
#include "arrays.hpp"
#include "handmap/hand_model.hpp"
#include "handmap/ik_models.hpp"
#include "handmap/posture.hpp"

namespace handmap {

using namespace nb::literals;

namespace {

// Postures (k, n) in which the first of k + 1 pads touches each other pad in turn; see
// hand_pair.RobotFingers.pinches. Pads are points on joints, at given distances where they touch.
// `usual` moves the same hand before it was scaled to this tree: its limits and weights hold here too,
// but those of reference points.
NumpyArray pinching_postures(const Tree& tree, const Ik& usual, const Indices& joints,
                             const Array& offsets, const Array& distances, double weight, double dt,
                             int samples, double tolerance) {
  DistanceTask task{attached_of(joints, offsets), {}, {}};
  const size_t count = distances.size(), n = tree.q_indices.size();
  expect_joints(tree, task.points);
  expect(!joints.empty(), "no pads");
  expect_size(distances, joints.size() - 1, "distances");
  expect(usual.limits.size() == tree.size && usual.limits.lowest.size() == static_cast<size_t>(tree.nq),
         "an Ik of another hand");
  for (size_t k = 0; k < count; ++k) {
    task.first.push_back(0);
    task.second.push_back(static_cast<int>(k + 1));
  }
  Ik ik(tree);
  ik.weights = usual.weights;
  ik.weights.points.clear();
  ik.settings = usual.settings;
  ik.limits = usual.limits;
  // The wrist stays, and no point has a target.
  ik.tree.points.clear();
  ik.tree.parts = {{tree.parts[0].joint, tree.parts[0].wrist, 0, 0}};
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

// See ik.nearest_posture, whose arguments these are.
NumpyArray nearest_posture(const Tree& tree, const Array& targets, const Array& costs,
                           double rest_cost, const Array& start) {
  expect_size(targets, 3 * tree.points.size(), "targets");
  expect_size(costs, tree.points.size(), "costs");
  expect_size(start, tree.q_indices.size(), "start");
  NearestPosture problem(tree);
  problem.targets = points_of(targets);
  problem.costs = vector_of(costs);
  for (double& cost : problem.costs) cost *= cost;
  problem.rest_cost = rest_cost * rest_cost;
  return array_of(problem.solve(vector_of(start)));
}

// Points in palm axes, of joint positions (k, n), one posture after the other.
NumpyArray points_in_palm(const Tree& tree, const Array& q, const std::vector<Attached>& points) {
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

// The same of points that links carry, by the names of those.
NumpyArray points_on_links(const Tree& tree, const Array& q, const std::vector<std::string>& links,
                           const Array& offsets) {
  expect_size(offsets, 3 * links.size(), "offsets");
  const std::vector<Vec3> at = points_of(offsets);
  std::vector<Attached> points;
  for (size_t k = 0; k < links.size(); ++k) points.push_back(tree.attached(links[k], at[k]));
  return points_in_palm(tree, q, points);
}

// Poses of the joints in a configuration, that of the world first.
NumpyArray joint_poses(const Tree& tree, const Array& q) {
  expect_size(q, static_cast<size_t>(tree.nq), "q");
  Placed placed(tree);
  placed.place(q.data());
  std::vector<Pose> poses;
  for (int j = -1; j < static_cast<int>(tree.joints.size()); ++j) poses.push_back(placed.pose(j));
  return array_of(poses);
}

// The reference points and the wrist of each hand in a configuration.
nb::tuple posture(const Tree& tree, const Array& q) {
  expect_size(q, static_cast<size_t>(tree.nq), "q");
  Placed placed(tree);
  placed.place(q.data());
  std::vector<Vec3> points;
  for (const Attached& point : tree.points) points.push_back(placed.point(point));
  std::vector<Pose> wrists;
  for (const Part& part : tree.parts) wrists.push_back(placed.wrist(part));
  return nb::make_tuple(array_of(points), array_of(wrists));
}

// The tree of a hand with joints in other places; see hands.Hand.with_lengths.
Tree moved_tree(const Tree& standard, const std::vector<std::string>& joints, const Array& origins,
                const Array& rolls) {
  expect_size(origins, 3 * joints.size(), "origins");
  expect_size(rolls, joints.size(), "rolls");
  const std::vector<Vec3> at = points_of(origins);
  Tree tree = standard;
  for (size_t k = 0; k < joints.size(); ++k) tree.move_joint(joints[k], at[k], rolls.data()[k]);
  return tree;
}

// The least distance of any of the pairs, or `most`, for joint positions (T, n).
NumpyArray smallest_distances(const Tree& tree, const PairBounds& bounds, const Array& q,
                              double most) {
  const size_t n = tree.q_indices.size();
  if (n == 0 || q.size() % n) throw std::invalid_argument("wrong size of q");
  bounds.expect_hand(tree);
  Vector found;
  Placed placed(tree);
  SmallestDistances smallest(bounds);
  for (size_t row = 0; row < q.size(); row += n) {
    placed.place(tree.configuration(q.data() + row).data());
    found.push_back(smallest.measure(placed, most));
  }
  return array_of(found);
}

}  // namespace

void bind_hands(nb::module_& m) {
  nb::class_<Tree>(m, "Tree")
      .def("__init__",
           [](Tree* self, const nb::bytes& hand) {
             new (self) Tree(tree_of(model_of<HandModel>(hand)));
           },
           "hand"_a)
      .def("moved", &moved_tree, "joints"_a, "origins"_a, "rolls"_a)
      .def("points",
           [](const Tree& tree, const Array& q) { return points_in_palm(tree, q, tree.points); },
           "q"_a)
      .def("points_on_links", &points_on_links, "q"_a, "links"_a, "offsets"_a)
      .def("points_on_joints",
           [](const Tree& tree, const Array& q, const Indices& joints, const Array& offsets) {
             const std::vector<Attached> points = attached_of(joints, offsets);
             expect_joints(tree, points);
             return points_in_palm(tree, q, points);
           },
           "q"_a, "joints"_a, "offsets"_a)
      .def("joint_poses", &joint_poses, "q"_a)
      .def("posture", &posture, "q"_a)
      .def("nearest_posture", &nearest_posture, "targets"_a, "costs"_a, "rest_cost"_a, "start"_a)
      .def("pinching_postures", &pinching_postures, "usual"_a, "joints"_a, "offsets"_a,
           "distances"_a, "weight"_a, "dt"_a, "samples"_a, "tolerance"_a)
      .def("smallest_distances", &smallest_distances, "pairs"_a, "q"_a, "most"_a);
  nb::class_<PairBounds>(m, "PairBounds")
      .def("__init__",
           [](PairBounds* self, const nb::bytes& pairs) {
             new (self) PairBounds(bounds_of(model_of<PairsModel>(pairs)));
           },
           "pairs"_a);
}

}  // namespace handmap
