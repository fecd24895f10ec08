// A dual active-set method for small dense problems (Goldfarb and Idnani, Math. Prog. 27, 1983):
//
//   min  1/2 x^T H x + c^T x   s.t.   lower <= x <= upper,   G x <= h,    H positive definite.
//
// It starts from the free minimum and takes in one violated constraint after the other. J and R
// hold J^T H J = I and J^T N = [R; 0], with the normals N of the active constraints.
#pragma once

#include <cmath>
#include <limits>
#include <vector>

namespace handmap {

class Qp {
 public:
  std::vector<double> x;
  int iterations = 0;

  // Return whether a minimum was found; G has `rows` rows, one after the other.
  bool solve(int n, const double* H, const double* c, const double* lower, const double* upper,
             int rows, const double* G, const double* h) {
    n_ = n;
    rows_ = rows;
    lower_ = lower;
    upper_ = upper;
    G_ = G;
    h_ = h;
    H_ = H;
    c_ = c;
    if (!start()) return false;
    const int most = 50 + 10 * (n + rows);
    for (iterations = 0; iterations < most; ++iterations) {
      int violated = most_violated();
      if (violated < 0) {
        // Rounding of the way is gone then, and what it hid may show.
        polish();
        violated = most_violated();
        if (violated < 0) return true;
      }
      if (!take(violated)) return false;
    }
    return false;
  }

 private:
  static constexpr double kInfinity = std::numeric_limits<double>::infinity();
  // A constraint whose normal has less than this share outside the active ones depends on them.
  static constexpr double kDependent = 1e-26;
  // Violations below this are rounding, relative to the solution or 1.
  static constexpr double kTolerance = 1e-12;
  // Pivots are at least this share of the diagonal.
  static constexpr double kLeastPivot = 1e-15;
  // A constraint that depends on the active ones may be violated by this much.
  static constexpr double kLoose = 1e-8;

  double* J(int i) { return J_.data() + i * n_; }
  double& R(int i, int j) { return R_[i * n_ + j]; }

  // Factor H, and go to the free minimum.
  bool start() {
    const int n = n_;
    J_.assign(n * n, 0.0);
    L_.resize(n * n);
    R_.resize(n * n);
    x.resize(n);
    d_.resize(n);
    z_.resize(n);
    r_.resize(n);
    active_.clear();
    multipliers_.clear();
    is_active_.assign(2 * n + rows_, 0);
    is_rounded_ = false;
    row_norms_.resize(rows_);
    for (int k = 0; k < rows_; ++k) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += G_[k * n + i] * G_[k * n + i];
      row_norms_[k] = std::sqrt(sum);
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        double sum = H_[i * n + j];
        for (int k = 0; k < j; ++k) sum -= L_[i * n + k] * L_[j * n + k];
        if (i != j) {
          L_[i * n + j] = sum / L_[j * n + j];
        } else {
          // Where targets are 1e18 m away, rounding may leave less than nothing of a pivot.
          const double least = kLeastPivot * H_[i * n + i];
          if (!(least > 0.0 && least < kInfinity)) return false;
          is_rounded_ |= !(sum > least);
          L_[i * n + i] = std::sqrt(std::max(sum, least));
        }
      }
    // J = L^-T: column by column of L^-1, which are rows of J.
    for (int j = 0; j < n; ++j) {
      J_[j * n + j] = 1.0 / L_[j * n + j];
      for (int i = j + 1; i < n; ++i) {
        double sum = 0.0;
        for (int k = j; k < i; ++k) sum -= L_[i * n + k] * J_[j * n + k];
        J_[j * n + i] = sum / L_[i * n + i];
      }
    }
    for (int i = 0; i < n; ++i) {  // x = -J J^T c
      double sum = 0.0;
      for (int k = 0; k <= i; ++k) sum += J_[k * n + i] * c_[k];
      d_[i] = sum;
    }
    for (int i = 0; i < n; ++i) {
      double sum = 0.0;
      for (int k = i; k < n; ++k) sum += J_[i * n + k] * d_[k];
      x[i] = -sum;
      if (!(std::abs(sum) < kInfinity)) return false;
    }
    return true;
  }

  // How far a constraint is on its right side; negative where it is violated.
  double slack(int k) const {
    if (k < n_) return x[k] - lower_[k];
    if (k < 2 * n_) return upper_[k - n_] - x[k - n_];
    const double* g = G_ + (k - 2 * n_) * n_;
    double sum = h_[k - 2 * n_];
    for (int i = 0; i < n_; ++i) sum -= g[i] * x[i];
    return sum;
  }

  int most_violated() const {
    double scale = 1.0;
    for (int i = 0; i < n_; ++i) scale = std::max(scale, std::abs(x[i]));
    int found = -1;
    double worst = -kTolerance * scale;
    for (int k = 0; k < 2 * n_ + rows_; ++k) {
      if (is_active_[k]) continue;
      double s = slack(k);
      if (k >= 2 * n_) {
        const double length = row_norms_[k - 2 * n_];
        if (length < 1e-12) continue;  // it holds no coordinate
        s /= length;
      }
      if (s < worst) {
        worst = s;
        found = k;
      }
    }
    return found;
  }

  // d = J^T normal
  void project(int k) {
    const int n = n_;
    if (k < 2 * n) {
      const double* row = J(k < n ? k : k - n);
      const double sign = k < n ? 1.0 : -1.0;
      for (int i = 0; i < n; ++i) d_[i] = sign * row[i];
      return;
    }
    const double* g = G_ + (k - 2 * n) * n;
    for (int i = 0; i < n; ++i) d_[i] = 0.0;
    for (int j = 0; j < n; ++j) {
      if (g[j] == 0.0) continue;
      const double* row = J(j);
      for (int i = 0; i < n; ++i) d_[i] -= g[j] * row[i];
    }
  }

  // Take in a violated constraint; drop others on the way. False if it contradicts them.
  bool take(int k) {
    const int n = n_;
    double own = 0.0;
    while (true) {
      const int count = static_cast<int>(active_.size());
      project(k);
      double all = 0.0, free = 0.0;
      for (int i = 0; i < n; ++i) all += d_[i] * d_[i];
      for (int i = count; i < n; ++i) free += d_[i] * d_[i];
      for (int i = count - 1; i >= 0; --i) {  // r = R^-1 d_1
        double sum = d_[i];
        for (int j = i + 1; j < count; ++j) sum -= R(i, j) * r_[j];
        r_[i] = sum / R(i, i);
      }
      double drop_at = kInfinity;
      int dropped = -1;
      for (int i = 0; i < count; ++i)
        if (r_[i] > 0.0 && multipliers_[i] < drop_at * r_[i]) {
          drop_at = multipliers_[i] / r_[i];
          dropped = i;
        }
      const double s = slack(k);
      const bool depends = !(free > kDependent * all) || count == n;
      const double full = depends ? kInfinity : std::max(-s, 0.0) / free;
      const double t = std::min(drop_at, full);
      if (t == kInfinity) {
        // It follows from the active ones: what is left is rounding, or a contradiction.
        const double length = k < 2 * n ? 1.0 : row_norms_[k - 2 * n];
        double scale = 1.0;
        for (int i = 0; i < n; ++i) scale = std::max(scale, std::abs(x[i]));
        is_active_[k] = 2;
        return s > -kLoose * scale * length;
      }
      for (int i = 0; i < count; ++i) multipliers_[i] = std::max(multipliers_[i] - t * r_[i], 0.0);
      own += t;
      if (!depends)
        for (int i = 0; i < n; ++i) {
          const double* row = J(i);
          double sum = 0.0;
          for (int j = count; j < n; ++j) sum += row[j] * d_[j];
          x[i] += t * sum;
        }
      if (full <= drop_at) {
        append(k, own);
        snap();
        return true;
      }
      remove(dropped);
    }
  }

  // Put coordinates exactly on their active bounds: from a free minimum that is 1e18 m away, they are
  // off by 100 m of rounding.
  void snap() {
    for (const int k : active_)
      if (k < 2 * n_) x[k < n_ ? k : k - n_] = k < n_ ? lower_[k] : upper_[k - n_];
  }

  // Turn two columns of J.
  void turn(int i, int j, double c, double s) {
    for (int k = 0; k < n_; ++k) {
      double* row = J(k);
      const double a = row[i], b = row[j];
      row[i] = c * a + s * b;
      row[j] = c * b - s * a;
    }
  }

  void append(int k, double multiplier) {
    const int count = static_cast<int>(active_.size());
    for (int j = n_ - 1; j > count; --j) {
      const double length = std::hypot(d_[j - 1], d_[j]);
      if (length == 0.0 || d_[j] == 0.0) continue;
      turn(j - 1, j, d_[j - 1] / length, d_[j] / length);
      d_[j - 1] = length;
      d_[j] = 0.0;
    }
    for (int i = 0; i <= count; ++i) R(i, count) = d_[i];
    active_.push_back(k);
    multipliers_.push_back(multiplier);
    is_active_[k] = 1;
  }

  void remove(int index) {
    const int count = static_cast<int>(active_.size());
    is_active_[active_[index]] = 0;
    active_.erase(active_.begin() + index);
    multipliers_.erase(multipliers_.begin() + index);
    for (int j = index; j < count - 1; ++j) {
      for (int i = 0; i <= j + 1; ++i) R(i, j) = R(i, j + 1);
      const double a = R(j, j), b = R(j + 1, j), length = std::hypot(a, b);
      if (length > 0.0) {
        const double c = a / length, s = b / length;
        R(j, j) = length;
        R(j + 1, j) = 0.0;
        for (int i = j + 2; i < count; ++i) {  // still in its old column
          const double p = R(j, i), q = R(j + 1, i);
          R(j, i) = c * p + s * q;
          R(j + 1, i) = c * q - s * p;
        }
        turn(j, j + 1, c, s);
      }
    }
    // What depended on a constraint that has gone may count again.
    for (char& flag : is_active_)
      if (flag == 2) flag = 0;
  }

  // Take out the rounding of the way from a free minimum that may be far away.
  void polish() {
    const int n = n_, count = static_cast<int>(active_.size());
    // Back onto the active constraints: x += J_1 R^-T (b - N^T x).
    for (int i = 0; i < count; ++i) {
      double sum = -slack(active_[i]);
      for (int j = 0; j < i; ++j) sum -= R(j, i) * r_[j];
      r_[i] = sum / R(i, i);
    }
    for (int i = 0; i < n; ++i) {
      const double* row = J(i);
      double sum = 0.0;
      for (int j = 0; j < count; ++j) sum += row[j] * r_[j];
      x[i] += sum;
    }
    if (is_rounded_) return;
    // And to the minimum along them: x -= J_2 J_2^T (H x + c).
    for (int i = 0; i < n; ++i) z_[i] = c_[i];
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) z_[i] += H_[i * n + j] * x[j];
    for (int j = count; j < n; ++j) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += J_[i * n + j] * z_[i];
      d_[j] = sum;
    }
    for (int i = 0; i < n; ++i) {
      const double* row = J(i);
      for (int j = count; j < n; ++j) x[i] -= row[j] * d_[j];
    }
  }

  int n_ = 0, rows_ = 0;
  const double *H_ = nullptr, *c_ = nullptr, *lower_ = nullptr, *upper_ = nullptr, *G_ = nullptr,
               *h_ = nullptr;
  std::vector<double> J_, L_, R_, d_, z_, r_, multipliers_, row_norms_;
  std::vector<int> active_;
  std::vector<char> is_active_;
  bool is_rounded_ = false;
};

}  // namespace handmap
