// The farthest vertex of a convex hull along a direction, from few candidates.
//
// Directions are those to the points of a cube around the origin. Its faces are cut into squares, and
// squares with many candidates into four again. A direction in a square is a sum of those to its
// corners with shares that are not negative. So a vertex is never the farthest one there if another
// vertex is farther along all four corners.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "vector.hpp"

namespace handmap {

class Hull {
 public:
  Hull() = default;
  explicit Hull(std::vector<Vec3> vertices) : vertices_(std::move(vertices)) {
    if (vertices_.size() <= kFew) return;
    for (const Vec3& vertex : vertices_) tolerance_ = std::max(tolerance_, 1e-12 * norm(vertex));
    std::vector<int> all(vertices_.size());
    for (size_t i = 0; i < all.size(); ++i) all[i] = static_cast<int>(i);
    cells_.resize(6 * kGrid * kGrid);
    for (int face = 0; face < 6; ++face) divide({face, 0.0, 0.0, 1.0}, all, 0);
  }

  const Vec3& vertex(int i) const { return vertices_[i]; }

  // The index of the farthest vertex.
  int farthest(const Vec3& d) const {
    int found = 0;
    if (cells_.empty()) {
      for (size_t i = 1; i < vertices_.size(); ++i)
        if (dot(vertices_[i] - vertices_[found], d) > 0.0) found = static_cast<int>(i);
      return found;
    }
    const Cell& cell = cell_of(d);
    const int* const candidates = candidates_.data() + cell.first;
    found = candidates[0];
    double most = dot(vertices_[found], d);
    for (int i = 1; i < cell.count; ++i) {
      const double reach = dot(vertices_[candidates[i]], d);
      if (reach > most) {
        most = reach;
        found = candidates[i];
      }
    }
    return found;
  }

 private:
  static constexpr size_t kFew = 16;
  static constexpr int kGrid = 16;
  static constexpr double kSmallest = 1.0 / 256.0;

  // A square of a face of the cube, in shares of the face's side.
  struct Square {
    int face;
    double u, v, side;
    Vec3 direction(double a, double b) const {
      Vec3 d;
      const int axis = face >> 1;
      d[axis] = face & 1 ? -1.0 : 1.0;
      d[(axis + 1) % 3] = 2.0 * (u + a * side) - 1.0;
      d[(axis + 2) % 3] = 2.0 * (v + b * side) - 1.0;
      return d;
    }
  };
  // A range of the candidates, or with count 0 the first of four cells.
  struct Cell {
    int first = 0, count = 0;
  };

  std::vector<int> undominated(const Square& square, const std::vector<int>& from) const {
    using Reach = std::array<double, 4>;  // along the corners
    const Vec3 corners[] = {square.direction(0, 0), square.direction(0, 1), square.direction(1, 0),
                            square.direction(1, 1)};
    std::vector<Reach> reaches;
    reaches.reserve(from.size());
    Reach best[5];  // of the farthest vertices along the corners, and along their middle
    double most[5];
    std::fill(most, most + 5, -std::numeric_limits<double>::infinity());
    for (const int i : from) {
      Reach reach;
      for (int k = 0; k < 4; ++k) reach[k] = dot(vertices_[i], corners[k]);
      for (int k = 0; k < 5; ++k) {
        const double far = k < 4 ? reach[k] : (reach[0] + reach[1]) + (reach[2] + reach[3]);
        if (!(far > most[k])) continue;
        most[k] = far;
        best[k] = reach;
      }
      reaches.push_back(reach);
    }
    std::vector<int> kept;
    for (size_t i = 0; i < from.size(); ++i) {
      bool is_dominated = false;
      for (int k = 4; k >= 0 && !is_dominated; --k) {
        is_dominated = true;
        for (int c = 0; c < 4; ++c) is_dominated &= best[k][c] - reaches[i][c] > tolerance_;
      }
      if (!is_dominated) kept.push_back(from[i]);
    }
    return kept;
  }

  // Squares of the grid have their own cells; smaller ones have the cell that is given.
  void divide(const Square& square, const std::vector<int>& from, int cell) {
    const std::vector<int> kept = undominated(square, from);
    const double half = 0.5 * square.side;
    if (square.side * kGrid == 1.0) {
      const int u = static_cast<int>(square.u * kGrid), v = static_cast<int>(square.v * kGrid);
      cell = (square.face * kGrid + u) * kGrid + v;
    }
    const bool is_large = square.side * kGrid > 1.0;
    int next = 0;
    if (!is_large) {
      if (kept.size() <= kFew || square.side <= kSmallest) {
        cells_[cell] = {static_cast<int>(candidates_.size()), static_cast<int>(kept.size())};
        candidates_.insert(candidates_.end(), kept.begin(), kept.end());
        return;
      }
      next = static_cast<int>(cells_.size());
      cells_[cell] = {next, 0};
      cells_.resize(cells_.size() + 4);
    }
    for (int k = 0; k < 4; ++k)
      divide({square.face, square.u + (k >> 1) * half, square.v + (k & 1) * half, half}, kept,
             next + k);
  }

  const Cell& cell_of(const Vec3& d) const {
    const double x = std::abs(d.x), y = std::abs(d.y), z = std::abs(d.z);
    const int axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
    const double a[] = {d.x, d.y, d.z, d.x, d.y};
    const double scale = 0.5 * kGrid / std::max(std::abs(a[axis]), 1e-300);
    // Also takes NaN, and numbers that no integer holds.
    const auto inside = [](double x) {
      return x > 0.0 ? static_cast<int>(std::min(x, kGrid - 1.0)) : 0;
    };
    double u = 0.5 * kGrid + scale * a[axis + 1], v = 0.5 * kGrid + scale * a[axis + 2];
    const int i = inside(u), j = inside(v);
    const Cell* cell = &cells_[((2 * axis + (a[axis] < 0.0)) * kGrid + i) * kGrid + j];
    u -= i;
    v -= j;
    while (cell->count == 0) {
      u *= 2.0;
      v *= 2.0;
      const int upper = u >= 1.0, right = v >= 1.0;
      u -= upper;
      v -= right;
      cell = &cells_[cell->first + 2 * upper + right];
    }
    return *cell;
  }

  std::vector<Vec3> vertices_;
  double tolerance_ = 0.0;
  std::vector<Cell> cells_;
  std::vector<int> candidates_;
};

}  // namespace handmap
