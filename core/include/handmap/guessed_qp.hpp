// The QP of one step, from a guess of the coordinates that end on a bound.
//
// Many coordinates stay on a bound from one step to the next: joints at their limits, or as fast as they
// may be. Those that are guessed are taken out, so that the rest has fewer coordinates and fewer active
// constraints. If the multipliers of their bounds have the right signs, the minimum of the rest is that
// of all, which is the only one; else the guess was wrong.
#pragma once

#include <algorithm>
#include <vector>

#include "qp.hpp"

namespace handmap {

class GuessedQp {
 public:
  std::vector<double> x;

  // Return whether a minimum was found; arguments as of `Qp::solve`. `guess` is -1 for coordinates on
  // their lower bound, 1 for those on their upper one. With `has_other_rows`, all but the rows is as in
  // the last call, so that H may be factored already.
  bool solve(int n, const double* H, const double* c, const double* lower, const double* upper,
             int rows, const double* G, const double* h, const std::vector<signed char>& guess,
             bool has_other_rows = false) {
    constexpr int kGuesses = 3;
    problem_ = {n, H, c, lower, upper, rows, G, h};
    if (!has_other_rows) factored_.clear();
    fixed_ = guess;
    for (int i = 0; i < kGuesses; ++i) {
      if (std::count(fixed_.begin(), fixed_.end(), 0) == n) break;
      if (!solve_rest()) break;
      if (!free_wrong()) return true;
    }
    fixed_.assign(n, 0);
    list_free();
    const bool has_found = qp_.solve(n, H, c, lower, upper, rows, G, h, are_factored(), expected());
    note_active();
    x = qp_.x;
    return has_found;
  }

  // Make room for problems of up to so many coordinates and rows.
  void reserve(size_t n, size_t rows) {
    qp_.reserve(n, rows);
    for (std::vector<signed char>* each : {&fixed_, &factored_, &bounds_}) each->reserve(n);
    for (std::vector<int>* each : {&free_, &active_rows_, &expected_}) each->reserve(n);
    for (std::vector<double>* each : {&x, &c_, &lower_, &upper_, &slope_, &pressed_}) each->reserve(n);
    H_.reserve(n * n);
    G_.reserve(n * rows);
    h_.reserve(rows);
  }

  // Rows are others from now on: which of them are active is not known.
  void forget_rows() {
    active_rows_.clear();
    bounds_.clear();
  }

  // Whether a row holds the minimum.
  bool has_active_row() const { return qp_.has_active_row(); }

  // The cost's derivative at the minimum, 0 where x is within `tight` of a bound.
  const std::vector<double>& slope(double tight) {
    find_slope();
    for (int i = 0; i < problem_.n; ++i)
      if (!(std::min(x[i] - problem_.lower[i], problem_.upper[i] - x[i]) > tight)) slope_[i] = 0.0;
    return slope_;
  }

 private:
  struct Problem {
    int n = 0;
    const double *H = nullptr, *c = nullptr, *lower = nullptr, *upper = nullptr;
    int rows = 0;
    const double *G = nullptr, *h = nullptr;
  };

  // Solve for the coordinates that are not fixed. False if that fails, or leaves a row to the others.
  bool solve_rest() {
    const auto& [n, H, c, lower, upper, rows, G, h] = problem_;
    x.assign(n, 0.0);
    list_free();
    for (int i = 0; i < n; ++i)
      if (fixed_[i] != 0) x[i] = fixed_[i] < 0 ? lower[i] : upper[i];
    find_slope();
    const int count = static_cast<int>(free_.size());
    if (count == 0) return false;
    H_.resize(count * count);
    G_.resize(rows * count);
    h_.resize(rows);
    for (std::vector<double>* part : {&c_, &lower_, &upper_}) part->resize(count);
    for (int a = 0; a < count; ++a) {
      const int i = free_[a];
      for (int b = 0; b <= a; ++b) H_[a * count + b] = H[i * n + free_[b]];
      c_[a] = slope_[i];
      lower_[a] = lower[i];
      upper_[a] = upper[i];
    }
    for (int r = 0; r < rows; ++r) {
      const double* g = G + r * n;
      h_[r] = h[r] - Qp::dot(g, x.data(), n);
      for (int a = 0; a < count; ++a) G_[r * count + a] = g[free_[a]];
    }
    const bool has_found = qp_.solve(count, H_.data(), c_.data(), lower_.data(), upper_.data(), rows,
                                     G_.data(), h_.data(), are_factored(), expected());
    note_active();
    if (!has_found || qp_.leaves_any()) return false;
    for (int a = 0; a < count; ++a) x[free_[a]] = qp_.x[a];
    find_slope();
    return true;
  }

  // List the coordinates that are not fixed.
  void list_free() {
    free_.clear();
    for (int i = 0; i < problem_.n; ++i)
      if (fixed_[i] == 0) free_.push_back(i);
  }

  // The constraints of the free coordinates that were active last, as of `Qp::active`.
  const std::vector<int>& expected() {
    const int count = static_cast<int>(free_.size());
    expected_.clear();
    for (int a = 0; a < count && !bounds_.empty(); ++a)
      if (bounds_[free_[a]] != 0) expected_.push_back(bounds_[free_[a]] < 0 ? a : count + a);
    for (const int r : active_rows_)
      if (r < problem_.rows) expected_.push_back(2 * count + r);
    return expected_;
  }

  // Note which constraints are active, so that the next problem of these rows starts from them.
  void note_active() {
    const int count = static_cast<int>(free_.size());
    active_rows_.clear();
    bounds_.assign(problem_.n, 0);
    for (const int k : qp_.active()) {
      if (k >= 2 * count)
        active_rows_.push_back(k - 2 * count);
      else
        bounds_[free_[k % count]] = static_cast<signed char>(k < count ? -1 : 1);
    }
  }

  // Whether H is factored for the coordinates that are not fixed; it is from now on.
  bool are_factored() {
    const bool they_are = factored_ == fixed_;
    factored_ = fixed_;
    return they_are;
  }

  // Free the coordinates that their bounds would hold from the wrong side. Return whether there are any.
  bool free_wrong() {
    const int n = problem_.n;
    pressed_ = slope_;
    qp_.add_rows(problem_.G, n, pressed_.data());
    bool is_any = false;
    for (int i = 0; i < n; ++i) {
      if (fixed_[i] == 0 || !(fixed_[i] * pressed_[i] > 0.0)) continue;
      if (problem_.lower[i] == problem_.upper[i]) continue;
      fixed_[i] = 0;
      is_any = true;
    }
    return is_any;
  }

  // slope_ = H x + c
  void find_slope() {
    const auto& [n, H, c, lower, upper, rows, G, h] = problem_;
    slope_.assign(c, c + n);
    Qp::add_product(n, H, x.data(), slope_.data());
  }

  Problem problem_;
  Qp qp_;
  std::vector<signed char> fixed_, factored_;
  std::vector<signed char> bounds_;  // that were active last: -1 for the lower one, 1 for the upper one
  std::vector<int> free_, active_rows_, expected_;
  std::vector<double> H_, c_, lower_, upper_, G_, h_, slope_, pressed_;
};

}  // namespace handmap
