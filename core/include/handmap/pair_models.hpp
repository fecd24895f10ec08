// Pairs of shapes as models; see models/shapes.py, which says what their fields are.
#pragma once

#include "model_reader.hpp"
#include "pairs.hpp"

namespace handmap {

struct ShapeModel {
  static constexpr const char* kName = "ShapeModel";
  std::string kind;
  Vec3 half;
  double radius = 0.0;
  std::vector<Vec3> corners;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("kind", kind);
    visit("half", half);
    visit("radius", radius);
    visit("corners", corners);
  }

  void check() const {
    expect_that(kind == "box" || kind == "sphere" || kind == "capsule" || kind == "convex",
                "ShapeModel.kind", "box, sphere, capsule or convex");
    if (kind != "convex") return;
    expect_that(!corners.empty(), "ShapeModel.corners", "a point at least");
    // Of NaN none is the farthest, so that each of 400,000 cells would have all points.
    for (const Vec3& corner : corners)
      expect_that(norm(corner) <= kFar, "ShapeModel.corners", "finite points");
  }
};

inline Shape shape_of(ShapeModel model) {
  if (model.kind == "box") return make_box(model.half);
  if (model.kind == "sphere") return make_sphere(model.radius);
  if (model.kind == "capsule") return make_capsule(model.radius, model.half.z);
  return make_convex(std::move(model.corners));
}

struct BodyModel {
  static constexpr const char* kName = "BodyModel";
  int joint = -1;
  Pose placement;
  ShapeModel shape;
  Vec3 centre;
  double radius = 0.0;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("joint", joint);
    visit("placement", placement);
    visit("shape", shape);
    visit("centre", centre);
    visit("radius", radius);
  }
};

struct PairsModel {
  static constexpr const char* kName = "PairsModel";
  std::vector<BodyModel> bodies;
  Indices first, second;
  Matrix levers, turns, signs;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("bodies", bodies);
    visit("first", first);
    visit("second", second);
    visit("levers", levers);
    visit("turns", turns);
    visit("signs", signs);
  }

  void check() const {
    // More than any hand has: there is a box for each joint up to the last.
    constexpr size_t kMostJoints = 1 << 16;
    for (const BodyModel& body : bodies) {
      expect_below("PairsModel.bodies: joint", {body.joint}, kMostJoints, -1);
      body.shape.check();
    }
    expect_count("PairsModel.second", second.size(), first.size());
    expect_below("PairsModel.first", first, bodies.size());
    expect_below("PairsModel.second", second, bodies.size());
    for (const Matrix* each : {&levers, &turns, &signs}) {
      expect_count("PairsModel: rows of levers, turns and signs", each->rows, first.size());
      expect_count("PairsModel: columns of levers, turns and signs", each->columns, levers.columns);
    }
  }
};

struct CollisionModel {
  static constexpr const char* kName = "CollisionModel";
  double margin = 0.0, horizon = kInfinity;
  std::optional<ContactYield> yielding;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("margin", margin);
    visit("horizon", horizon);
    visit("yielding", yielding);
  }
  void check() const {}
};

inline Sparse sparse_of(const Matrix& matrix, size_t row) {
  Sparse sparse;
  for (size_t c = 0; c < matrix.columns; ++c) {
    const double value = matrix.row(row)[c];
    if (value == 0.0) continue;
    sparse.columns.push_back(static_cast<int>(c));
    sparse.values.push_back(value);
  }
  return sparse;
}

inline PairBounds bounds_of(PairsModel model) {
  PairBounds bounds;
  for (BodyModel& body : model.bodies)
    bounds.bodies.push_back({body.joint, body.placement, shape_of(std::move(body.shape)),
                             body.centre, body.radius});
  for (size_t k = 0; k < model.first.size(); ++k)
    bounds.pairs.push_back({model.first[k], model.second[k], sparse_of(model.levers, k),
                            sparse_of(model.turns, k), sparse_of(model.signs, k)});
  bounds.finish();
  return bounds;
}

// Pairs of a hand that are kept apart.
inline std::unique_ptr<Pairs> pairs_of(const Tree& tree, std::shared_ptr<const PairBounds> bounds,
                                       CollisionModel model) {
  bounds->expect_hand(tree);
  const size_t count = bounds->pairs.size(), size = static_cast<size_t>(tree.size);
  auto pairs = std::make_unique<Pairs>(tree, std::move(bounds));
  pairs->margin = model.margin;
  pairs->horizon = model.horizon;
  if (model.yielding) {
    const ContactYield& given = *model.yielding;
    expect_count("CollisionModel.yielding.forces", given.forces.size(), count);
    expect_count("CollisionModel.yielding.depths", given.depths.size(), count);
    expect_count("CollisionModel.yielding.compliances", given.compliances.size(), size);
    expect_count("CollisionModel.yielding.torques", given.torques.size(), size);
    pairs->yielding = std::move(*model.yielding);
  }
  return pairs;
}

}  // namespace handmap
