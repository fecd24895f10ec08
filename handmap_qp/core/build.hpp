// The core's objects, made of those of Python: hands of Pinocchio, shapes of coal, and maps.
//
// Attributes have the same names on both sides.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <numeric>
#include <stdexcept>

#include "busy.hpp"
#include "hand_model.hpp"
#include "step.hpp"

namespace nb = nanobind;

namespace handmap {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

template <class Model>
Model model_of(const nb::bytes& bytes) {
  return decode<Model>({bytes.c_str(), bytes.size()});
}

inline Vector vector_of(const Array& a) { return Vector(a.data(), a.data() + a.size()); }

inline void expect_size(const Array& a, size_t size, const char* name) {
  if (a.size() != size) throw std::invalid_argument(std::string("wrong size of ") + name);
}

// Reject what other sizes or indices would lead out of: Python may build an object of parts of others.
inline void expect(bool is_right, const char* problem) {
  if (!is_right) throw std::invalid_argument(problem);
}
inline void expect_indices(const std::vector<int>& indices, size_t count, const char* name) {
  for (const int i : indices)
    if (i < 0 || static_cast<size_t>(i) >= count)
      throw std::invalid_argument(std::string("wrong index in ") + name);
}

inline std::vector<Vec3> points_of(const Array& a) {
  std::vector<Vec3> points(a.size() / 3);
  for (size_t k = 0; k < points.size(); ++k)
    points[k] = {a.data()[3 * k], a.data()[3 * k + 1], a.data()[3 * k + 2]};
  return points;
}

inline std::vector<Attached> attached_of(const Indices& joints, const Array& offsets) {
  expect_size(offsets, 3 * joints.size(), "offsets");
  const std::vector<Vec3> at = points_of(offsets);
  std::vector<Attached> points(joints.size());
  // Pinocchio counts the world as joint 0.
  for (size_t k = 0; k < points.size(); ++k) points[k] = {joints[k] - 1, at[k]};
  return points;
}

// Attributes of an object of Python, whose names the core shares; a path goes on by dots.
class Fields {
 public:
  explicit Fields(const nb::object& owner) : owner_(owner) {}
  const nb::object& owner() const { return owner_; }
  nb::object object(const std::string& path) const {
    nb::object found = owner_;
    for (size_t from = 0; from < path.size();) {
      const size_t to = std::min(path.find('.', from), path.size());
      found = nb::getattr(found, path.substr(from, to - from).c_str());
      from = to + 1;
    }
    return found;
  }
  template <class T>
  T get(const std::string& path) const {
    return nb::cast<T>(object(path));
  }
  Array array(const std::string& path, size_t size) const {
    const Array numbers = get<Array>(path);
    expect_size(numbers, size, path.c_str());
    return numbers;
  }
  Vector numbers(const std::string& path) const { return vector_of(get<Array>(path)); }
  Indices indices(const std::string& path) const {
    return nb::cast<Indices>(nb::getattr(object(path), "tolist")());
  }
  std::vector<Vec3> points(const std::string& path) const { return points_of(get<Array>(path)); }
  Vec3 point(const std::string& path) const { return points_of(array(path, 3))[0]; }
  Pose pose(const std::string& path) const { return pose_of(array(path, 16).data()); }
  Mat3 matrix(const std::string& path) const {
    const Array numbers = array(path, 9);
    Mat3 found;
    std::copy(numbers.data(), numbers.data() + 9, found.m);
    return found;
  }

 private:
  nb::object owner_;
};

// The package that this core is part of: handmap_qp, or handmap_run (examples/run).
inline std::string& package() {
  static std::string name;
  return name;
}
inline Fields module_of(const char* name) {
  return Fields(nb::module_::import_((package() + '.' + name).c_str()));
}

// The element of a sequence of Python.
inline nb::object item(const nb::object& sequence, size_t i) { return sequence[nb::int_(i)]; }

inline void expect_joints(const Tree& tree, const std::vector<Attached>& points) {
  for (const Attached& point : points)
    expect(tree.has_joint(point.joint), "points of another hand");
}

inline void set_weights(Ik& ik, const Fields& hand, const Fields& options) {
  const Array costs = nb::cast<Array>(options.object("point_costs")(hand.owner()));
  expect_size(costs, ik.tree.points.size(), "point costs");
  const nb::object wrist = options.object("wrist_costs");
  ik.weights = {vector_of(costs), nb::cast<double>(item(wrist, 0)), nb::cast<double>(item(wrist, 1)),
                options.get<double>("damping"), options.get<double>("error_damping")};
  ik.settings = {options.get<int>("max_iterations"), options.get<double>("step_tolerance"),
                 options.get<double>("point_tolerance"), options.get<double>("rest_weight"),
                 options.get<double>("speed_weight"), options.get<double>("acceleration_weight"),
                 options.get<bool>("points_follow_wrist")};
}

inline void set_limits(Gate& gate, const nb::bytes& bytes) {
  BoxLimits& limits = gate.limits = model_of<BoxLimits>(bytes);
  expect_count("BoxLimits.lowest", limits.lowest.size(), static_cast<size_t>(gate.tree.nq));
  expect_count("BoxLimits.lower", limits.lower.size(), static_cast<size_t>(gate.tree.size));
}

inline Shape make_shape(const Fields& from) {
  const std::string kind = nb::cast<std::string>(nb::getattr(from.owner().type(), "__name__"));
  if (kind == "Box") return make_box(from.point("halfSide"));
  if (kind == "Sphere") return make_sphere(from.get<double>("radius"));
  if (kind == "Capsule")
    return make_capsule(from.get<double>("radius"), from.get<double>("halfLength"));
  if (kind != "Convex") throw std::domain_error("a shape that is not convex: " + kind);
  std::vector<Vec3> points = points_of(nb::cast<Array>(from.object("points")()));
  // Of NaN none is the farthest, so that each of 400,000 cells would have all points.
  expect(!points.empty() && is_near(&points[0].x, 3 * points.size()), "a hull of no finite points");
  return make_convex(std::move(points));
}

inline Sparse sparse_of(const Array& matrix, size_t row) {
  const size_t count = matrix.shape(1);
  Sparse sparse;
  for (size_t c = 0; c < count; ++c) {
    const double value = matrix.data()[row * count + c];
    if (value == 0.0) continue;
    sparse.columns.push_back(static_cast<int>(c));
    sparse.values.push_back(value);
  }
  return sparse;
}

inline void make_bounds(PairBounds* self, const nb::object& owner) {
  const Fields from(owner);
  PairBounds& bounds = *new (self) PairBounds();
  for (const nb::handle& each : from.object("geometry.geometryObjects")) {
    const Fields body(nb::borrow(each));
    const Pose placement = body.pose("placement.homogeneous");
    bounds.bodies.push_back({body.get<int>("parentJoint") - 1, placement,
                             make_shape(Fields(body.object("geometry"))),
                             placement * body.point("geometry.aabb_center"),
                             body.get<double>("geometry.aabb_radius")});
    const int joint = bounds.bodies.back().joint;
    expect(joint >= -1 && joint < 1 << 16, "a shape of no joint");
  }
  const Array levers = from.get<Array>("levers"), turns = from.get<Array>("turns"),
              signs = from.get<Array>("signs");
  for (const Array* each : {&levers, &turns, &signs})
    expect(each->ndim() == 2, "levers, turns and signs have a row for each pair");
  size_t k = 0;
  for (const nb::handle& each : from.object("geometry.collisionPairs")) {
    const Fields pair(nb::borrow(each));
    expect(k < levers.shape(0) && k < turns.shape(0) && k < signs.shape(0), "too many pairs");
    expect_indices({pair.get<int>("first"), pair.get<int>("second")}, bounds.bodies.size(), "pairs");
    bounds.pairs.push_back({pair.get<int>("first"), pair.get<int>("second"), sparse_of(levers, k),
                            sparse_of(turns, k), sparse_of(signs, k)});
    ++k;
  }
  bounds.finish();
}

// `from` is a CollisionLimit.
inline std::unique_ptr<Pairs> make_pairs(const Tree& tree, const Fields& from) {
  const auto bounds = from.get<std::shared_ptr<PairBounds>>("bounds.core");
  for (const Body& body : bounds->bodies) expect(tree.has_joint(body.joint), "shapes of another hand");
  for (const Pair& pair : bounds->pairs)
    for (const Sparse* each : {&pair.levers, &pair.turns, &pair.signs})
      expect_indices(each->columns, static_cast<size_t>(tree.nv), "the levers of pairs");
  auto pairs = std::make_unique<Pairs>(tree, bounds);
  pairs->margin = from.get<double>("margin");
  pairs->horizon = from.get<double>("horizon");
  const nb::object yielding = from.object("yielding");
  if (!yielding.is_none()) {
    const Fields given(yielding);
    pairs->yielding = {given.numbers("forces"), given.numbers("depths"),
                       given.numbers("compliances"), given.numbers("torques")};
    const ContactYield& own = pairs->yielding;
    const size_t count = bounds->pairs.size(), size = static_cast<size_t>(tree.size);
    expect(own.forces.size() == count && own.depths.size() == count &&
               own.compliances.size() == size && own.torques.size() == size,
           "wrong size of what yields");
  }
  return pairs;
}

// Set what a gate of a hand admits: by its `BoxLimits`, and by its `CollisionLimit` or None.
inline void set_gate(Gate& gate, const nb::bytes& limits, const nb::object& collisions) {
  set_limits(gate, limits);
  if (!collisions.is_none()) gate.pairs = make_pairs(gate.tree, Fields(collisions));
  gate.motion = {Vector(gate.tree.nq, 0.0), Vector(gate.tree.size, 0.0), 1.0,
                 Vector(gate.tree.size, 0.0), 0.0, new_stamp(), 0};
}

// What moves a hand of Python.
struct PythonIk : Ik {
  nb::object hand, links;  // of each pair of shapes that are kept apart; at -1, there are none
  nb::object placed = {};  // a `Configuration`, where tasks of Python are linearised

  PythonIk(const Tree& tree, nb::object own_hand, nb::object own_links)
      : Ik(tree), hand(std::move(own_hand)), links(std::move(own_links)) {}
};

// Of a hand and its tree, `IkOptions`, `BoxLimits`, and a `CollisionLimit` or None with its links.
inline void make_ik(PythonIk* self, const Tree& tree, const nb::object& hand,
                    const nb::object& options, const nb::bytes& limits,
                    const nb::object& collisions, const nb::object& links) {
  PythonIk& ik = *new (self) PythonIk(tree, hand, links);
  set_weights(ik, Fields(hand), Fields(options));
  ik.takes_detours = Fields(options).get<bool>("takes_detours");
  ik.stop_detours();
  set_gate(ik, limits, collisions);
}

inline std::vector<Attached> points_of_task(const Fields& task) {
  return attached_of(task.get<Indices>("points.joints"), task.get<Array>("points.offsets"));
}

inline void make_distances(DistanceTask* self, const nb::object& owner) {
  const Fields from(owner);
  DistanceTask& task = *new (self)
      DistanceTask{points_of_task(from), from.indices("first"), from.indices("second")};
  expect(task.first.size() == task.second.size(), "first and second have one size");
  for (const std::vector<int>* each : {&task.first, &task.second})
    expect_indices(*each, task.points.size(), "points");
}

// Of a `PointOffset`.
inline OffsetTask offset_of(const Fields& task) {
  const std::vector<Attached> ends = points_of_task(task);
  return {ends.at(0), ends.at(1), task.point("aim"), task.get<double>("weight") / kLengthUnit};
}

}  // namespace handmap
