// Convex shapes, and the signed distance between two of them: GJK (Gilbert, Johnson and Keerthi,
// IEEE J. Robotics Autom. 4, 1988), and EPA (van den Bergen, 2001) where they overlap.
//
// Spheres are points, capsules are segments, with a radius around them. Polytopes end at the exact
// pair of features, so that normals are exact up to rounding. A pair starts from its last simplex.
// A sphere beside a shape other than a hull needs neither.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "hull.hpp"

namespace handmap {

enum class ShapeKind { box, point, segment, convex };

struct Shape {
  ShapeKind kind;
  Vec3 half;            // half sides of a box; half length of a segment in z
  double radius = 0.0;  // around a point or a segment
  Hull hull;
};

struct Found {
  double distance;  // negative where the shapes overlap [m]
  Vec3 normal;      // from the first shape to the second, in the world
  Vec3 point;       // nearest point of the first shape
};

// A vertex of a - b, with the points of both that it comes from, in their own axes.
struct Support {
  Vec3 w, a, b;
  int index_a = -1, index_b = -1;  // vertices
};

// What the next measurement of a pair starts from.
struct Warm {
  std::array<Support, 4> points;
  int count = 0;
};

inline Shape make_box(const Vec3& half) { return {ShapeKind::box, half, 0.0, {}}; }
inline Shape make_sphere(double radius) { return {ShapeKind::point, {}, radius, {}}; }
inline Shape make_capsule(double radius, double half_length) {
  return {ShapeKind::segment, {0, 0, half_length}, radius, {}};
}
inline Shape make_convex(std::vector<Vec3> vertices) {
  return {ShapeKind::convex, {}, 0.0, Hull(std::move(vertices))};
}

// The farthest vertex of a shape along a direction, in its own axes, and its index.
inline Vec3 farthest(const Shape& shape, const Vec3& d, int& index) {
  switch (shape.kind) {
    case ShapeKind::point:
      index = 0;
      return {};
    case ShapeKind::segment:
      index = d.z < 0.0;
      return {0.0, 0.0, index ? -shape.half.z : shape.half.z};
    case ShapeKind::box:
      index = (d.x < 0.0) + 2 * (d.y < 0.0) + 4 * (d.z < 0.0);
      return {d.x < 0.0 ? -shape.half.x : shape.half.x, d.y < 0.0 ? -shape.half.y : shape.half.y,
              d.z < 0.0 ? -shape.half.z : shape.half.z};
    case ShapeKind::convex:
      break;
  }
  index = shape.hull.farthest(d);
  return shape.hull.vertex(index);
}

// How far a shape reaches along a unit direction, in its own axes.
inline double reach(const Shape& shape, const Vec3& d) {
  const Vec3& half = shape.half;
  if (shape.kind == ShapeKind::box)
    return half.x * std::abs(d.x) + half.y * std::abs(d.y) + half.z * std::abs(d.z);
  int index;
  return dot(d, farthest(shape, d, index)) + shape.radius;
}

// A simplex, and its point that is nearest to the origin; `shares` are those of the vertices in it.
class Simplex {
 public:
  std::array<Support, 4> points;
  std::array<double, 4> shares{};
  int count = 0;

  // Find the nearest point; false if the origin is inside. After a vertex was added to a simplex that
  // was reduced, only what has that vertex can be nearer.
  bool reduce(Vec3& nearest, bool is_grown = false) {
    best2_ = std::numeric_limits<double>::infinity();
    is_grown_ = is_grown;
    if (count == 4) {
      if (contains_origin()) return false;
      if (is_outside_[0]) try_triangle(1, 2, 3);
      if (is_outside_[1]) try_triangle(0, 2, 3);
      if (is_outside_[2]) try_triangle(0, 1, 3);
      if (is_outside_[3] && !is_grown) try_triangle(0, 1, 2);
    } else if (count == 3) {
      try_triangle(0, 1, 2);
    } else if (count == 2) {
      try_edge(0, 1);
    } else {
      try_point(0);
    }
    nearest = best_point_;
    return true;
  }

  // Keep the vertices that the nearest point needs; their order stays.
  void keep_used() {
    count = best_count_;
    for (int i = 0; i < count; ++i) {
      if (best_[i] != i) points[i] = points[best_[i]];
      shares[i] = best_shares_[i];
    }
  }

 private:
  const Vec3& w(int i) const { return points[i].w; }

  bool contains_origin() {
    bool inside = true;
    for (int i = 0; i < 4; ++i) {
      const Vec3 &a = w((i + 1) & 3), &b = w((i + 2) & 3), &c = w((i + 3) & 3);
      const Vec3 normal = cross(b - a, c - a);
      const double own = dot(normal, w(i) - a), origin = -dot(normal, a);
      // A flat tetrahedron has no inside.
      const double flat2 = 1e-28 * dot(normal, normal) * (dot(w(i), w(i)) + dot(a, a));
      is_outside_[i] = !(own * own > flat2) || own * origin < 0.0;
      inside &= !is_outside_[i];
    }
    return inside;
  }

  void keep(const Vec3& point, std::array<int, 3> which, std::array<double, 3> parts, int number) {
    const double length2 = dot(point, point);
    if (!(length2 < best2_)) return;
    best2_ = length2;
    best_point_ = point;
    best_ = which;
    best_shares_ = parts;
    best_count_ = number;
  }

  void try_point(int i) { keep(w(i), {i, 0, 0}, {1.0, 0.0, 0.0}, 1); }

  void try_edge(int i, int j) {
    const Vec3 &a = w(i), &b = w(j), d = b - a;
    const double along = -dot(a, d), length2 = dot(d, d);
    if (!(along > 0.0)) return try_point(i);
    if (!(along < length2)) return try_point(j);
    const double t = along / length2;
    // From the nearer end, so that less is lost.
    const Vec3 point = t < 0.5 ? a + t * d : b - (1.0 - t) * d;
    keep(point, {i, j, 0}, {1.0 - t, t, 0.0}, 2);
  }

  void try_triangle(int i, int j, int k) {
    const Vec3 &a = w(i), &b = w(j), &c = w(k);
    const Vec3 normal = cross(b - a, c - a);
    const double length2 = dot(normal, normal);
    const double u = dot(normal, cross(b, c)), v = dot(normal, cross(c, a)),
                 s = dot(normal, cross(a, b));
    const double sum = u + v + s;
    if (length2 > 0.0 && sum > 0.0 && u > 0.0 && v > 0.0 && s > 0.0) {
      const Vec3 point = (dot(normal, a) / length2) * normal;
      return keep(point, {i, j, k}, {u / sum, v / sum, s / sum}, 3);
    }
    if (!is_grown_) try_edge(i, j);
    try_edge(j, k);
    try_edge(i, k);
  }

  bool is_grown_ = false;
  double best2_ = 0.0;
  Vec3 best_point_;
  std::array<int, 3> best_{};
  std::array<double, 3> best_shares_{};
  int best_count_ = 0;
  std::array<bool, 4> is_outside_{};
};

// Both shapes, in the axes of the first one.
class Difference {
 public:
  Difference(const Shape& a, const Shape& b, const Pose& b_in_a) : a_(a), b_(b), to_a_(b_in_a) {}

  Support along(const Vec3& d) const {
    Support s;
    s.a = farthest(a_, d, s.index_a);
    s.b = farthest(b_, -tmul(to_a_.R, d), s.index_b);
    s.w = s.a - to_a_ * s.b;
    return s;
  }
  void place(Support& s) const { s.w = s.a - to_a_ * s.b; }

 private:
  const Shape &a_, &b_;
  const Pose to_a_;
};

// Depth of two shapes that overlap: the face of a - b that is nearest to the origin. It keeps its memory
// for the next two.
class Expansion {
 public:
  // Make room for shapes of links, which need a quarter of it.
  void reserve() {
    vertices_.reserve(64);
    faces_.reserve(512);
    rim_.reserve(64);
  }

  // Return whether a face was found: depth, outward normal, and the first shape's point.
  bool run(const Difference& both, const Simplex& start, double& depth, Vec3& normal, Vec3& point) {
    vertices_.clear();
    faces_.clear();
    for (int i = 0; i < start.count; ++i) vertices_.push_back(start.points[i]);
    if (!complete(both)) return false;
    for (int round = 0; round < 200; ++round) {
      const int k = nearest_face();
      if (k < 0) return false;
      const Face face = faces_[k];
      const Support s = both.along(face.normal);
      const double gain = dot(s.w, face.normal) - face.distance;
      if (gain <= 1e-12 || is_known(s) || !grow(s)) return finish(face, depth, normal, point);
    }
    const int k = nearest_face();
    return k >= 0 && finish(faces_[k], depth, normal, point);
  }

 private:
  struct Face {
    std::array<int, 3> v;
    Vec3 normal;
    double distance;
    bool is_gone;
  };

  bool is_known(const Support& s) const {
    for (const Support& v : vertices_)
      if (norm(v.w - s.w) < 1e-14) return true;
    return false;
  }

  // Make a tetrahedron with a volume around the origin.
  bool complete(const Difference& both) {
    static const Vec3 directions[] = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0},
                                      {0, -1, 0}, {0, 0, 1}, {0, 0, -1}};
    while (vertices_.size() < 4) {
      Support best;
      double most = 1e-10;
      auto consider = [&](const Vec3& d) {
        const Support s = both.along(d);
        const double size = spread(s.w);
        if (size > most) {
          most = size;
          best = s;
        }
      };
      for (const Vec3& d : directions) consider(d);
      if (vertices_.size() >= 2) {
        const Vec3 edge = vertices_[1].w - vertices_[0].w;
        for (const Vec3& d : directions) consider(cross(edge, d));
      }
      if (vertices_.size() == 3) {
        const Vec3 n = cross(vertices_[1].w - vertices_[0].w, vertices_[2].w - vertices_[0].w);
        consider(n);
        consider(-n);
      }
      if (most == 1e-10) return false;
      vertices_.push_back(best);
    }
    centre_ = {};
    for (int i = 0; i < 4; ++i) centre_ += 0.25 * vertices_[i].w;
    add_face(0, 1, 2);
    add_face(0, 1, 3);
    add_face(0, 2, 3);
    add_face(1, 2, 3);
    return true;
  }

  // How far a point is from the hull of the vertices so far: distance, height over the line, plane.
  double spread(const Vec3& p) const {
    if (vertices_.empty()) return 1.0;
    const Vec3 d = p - vertices_[0].w;
    if (vertices_.size() == 1) return norm(d);
    const Vec3 e = vertices_[1].w - vertices_[0].w;
    if (vertices_.size() == 2) return norm(cross(d, e)) / norm(e);
    const Vec3 n = cross(e, vertices_[2].w - vertices_[0].w);
    return std::abs(dot(d, n)) / norm(n);
  }

  void add_face(int i, int j, int k) {
    const Vec3 &a = vertices_[i].w, &b = vertices_[j].w, &c = vertices_[k].w;
    Vec3 n = cross(b - a, c - a);
    const double length = norm(n);
    Face face{{i, j, k}, {}, std::numeric_limits<double>::infinity(), false};
    if (length > 0.0) {
      n *= 1.0 / length;
      if (dot(n, a - centre_) < 0.0) {
        n = -n;
        std::swap(face.v[1], face.v[2]);
      }
      face.normal = n;
      face.distance = dot(n, a);
    }
    faces_.push_back(face);
  }

  int nearest_face() const {
    int found = -1;
    double best = std::numeric_limits<double>::infinity();
    for (size_t k = 0; k < faces_.size(); ++k)
      if (!faces_[k].is_gone && faces_[k].distance < best) {
        best = faces_[k].distance;
        found = static_cast<int>(k);
      }
    return found;
  }

  // Take a vertex in: faces that see it go, and their rim gets new ones.
  bool grow(const Support& s) {
    rim_.clear();
    bool sees = false;
    for (Face& face : faces_) {
      if (face.is_gone || !(dot(face.normal, s.w) - face.distance > 1e-14)) continue;
      sees = face.is_gone = true;
      for (int i = 0; i < 3; ++i) {
        const std::array<int, 2> edge{face.v[i], face.v[(i + 1) % 3]};
        const auto twin = std::find(rim_.begin(), rim_.end(), std::array<int, 2>{edge[1], edge[0]});
        if (twin != rim_.end()) {
          rim_.erase(twin);
        } else {
          rim_.push_back(edge);
        }
      }
    }
    if (!sees) return false;
    vertices_.push_back(s);
    const int last = static_cast<int>(vertices_.size()) - 1;
    for (const std::array<int, 2>& edge : rim_) add_face(edge[0], edge[1], last);
    return true;
  }

  bool finish(const Face& face, double& depth, Vec3& normal, Vec3& point) const {
    depth = face.distance;
    normal = face.normal;
    const Support &a = vertices_[face.v[0]], &b = vertices_[face.v[1]], &c = vertices_[face.v[2]];
    const Vec3 p = depth * normal;
    const double u = dot(normal, cross(b.w - p, c.w - p)), v = dot(normal, cross(c.w - p, a.w - p)),
                 s = dot(normal, cross(a.w - p, b.w - p)), sum = u + v + s;
    point = (1.0 / sum) * (u * a.a + v * b.a + s * c.a);
    return std::isfinite(depth) && sum != 0.0;
  }

  Vec3 centre_;
  std::vector<Support> vertices_;
  std::vector<Face> faces_;
  std::vector<std::array<int, 2>> rim_;
};

// Find the point of a shape that is nearest to a point, both in its own axes. False for hulls, and
// where the point is inside.
inline bool find_nearest(const Shape& shape, const Vec3& to, Vec3& nearest) {
  if (shape.kind == ShapeKind::convex) return false;
  const Vec3& half = shape.half;
  const auto clamp = [](double x, double most) { return std::min(std::max(x, -most), most); };
  nearest = {clamp(to.x, half.x), clamp(to.y, half.y), clamp(to.z, half.z)};
  return dot(to - nearest, to - nearest) >= 1e-24;
}

// Measure the signed distance of two shapes.
inline Found measure(const Shape& a, const Pose& pose_a, const Shape& b, const Pose& pose_b,
                     Warm& warm, Expansion& expansion) {
  constexpr int kMost = 200;
  const Pose b_in_a = inverse(pose_a) * pose_b;
  const double radii = a.radius + b.radius;
  const auto found = [&](double distance, const Vec3& normal, const Vec3& point) {
    return Found{distance - radii, pose_a.R * normal, pose_a * (point + a.radius * normal)};
  };
  Vec3 on;
  if (b.kind == ShapeKind::point && find_nearest(a, b_in_a.p, on)) {
    const double length = norm(b_in_a.p - on);
    return found(length, (1.0 / length) * (b_in_a.p - on), on);
  }
  if (a.kind == ShapeKind::point && find_nearest(b, inverse(b_in_a).p, on)) {
    const Vec3 offset = b_in_a * on;
    const double length = norm(offset);
    return found(length, (1.0 / length) * offset, {});
  }
  const Difference both(a, b, b_in_a);
  Simplex simplex;
  Vec3 v;
  bool is_apart = true;
  if (warm.count > 0) {
    simplex.points = warm.points;
    simplex.count = warm.count;
    for (int i = 0; i < simplex.count; ++i) both.place(simplex.points[i]);
    is_apart = simplex.reduce(v);
    if (is_apart) simplex.keep_used();
  } else {
    simplex.points[0] = both.along({1.0, 0.0, 0.0});
    simplex.count = 1;
    simplex.reduce(v);
    simplex.keep_used();
  }
  for (int round = 0; is_apart && round < kMost; ++round) {
    const double length2 = dot(v, v);
    if (length2 < 1e-24) {
      is_apart = false;
      break;
    }
    const Support s = both.along(-v);
    // No point of a - b is farther ahead by more than rounding: v is the nearest one.
    const double ahead = length2 - dot(v, s.w);
    if (ahead <= 1e-15 * length2 + 4e-17 * std::sqrt(length2) * (norm(s.a) + norm(s.b))) break;
    bool is_known = false;
    for (int i = 0; i < simplex.count; ++i)
      is_known |=
          simplex.points[i].index_a == s.index_a && simplex.points[i].index_b == s.index_b;
    if (is_known) break;
    simplex.points[simplex.count++] = s;
    Vec3 next;
    if (!simplex.reduce(next, true)) {
      is_apart = false;
      break;
    }
    if (!(dot(next, next) < length2)) {
      --simplex.count;
      break;
    }
    simplex.keep_used();
    v = next;
  }
  double distance = 0.0;
  Vec3 normal{1.0, 0.0, 0.0}, point;
  warm.points = simplex.points;
  warm.count = std::min(simplex.count, 3);
  if (is_apart) {
    const double length = norm(v);
    distance = length;
    normal = (-1.0 / length) * v;
    for (int i = 0; i < simplex.count; ++i) point += simplex.shares[i] * simplex.points[i].a;
  } else {
    double depth = 0.0;
    if (expansion.run(both, simplex, depth, normal, point)) distance = -depth;
  }
  return found(distance, normal, point);
}
inline Found measure(const Shape& a, const Pose& pose_a, const Shape& b, const Pose& pose_b,
                     Warm& warm) {
  Expansion expansion;
  return measure(a, pose_a, b, pose_b, warm, expansion);
}

}  // namespace handmap
