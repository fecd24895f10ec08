// A dual active-set method for small dense problems (Goldfarb and Idnani, Math. Prog. 27, 1983):
//
//   min  1/2 x^T H x + c^T x   s.t.   lower <= x <= upper,   G x <= h,    H positive definite.
//
// It starts from the free minimum and takes in one violated constraint after the other. J and R
// hold J^T H J = I and J^T N = [R; 0], with the normals N of the active constraints.
#pragma once

#include <algorithm>
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
    int corrections = 0;
    for (iterations = 0; iterations < most; ++iterations) {
      int violated = most_violated();
      if (is_small(violated)) {
        // Rounding of the way is gone then, and what it hid may show.
        polish();
        violated = most_violated();
        // What is left after so many times is rounding of active constraints that nearly depend on
        // each other.
        const bool is_right = violated < 0 && (!is_far_ || is_rounded_ || !drop_negative());
        if (is_right || (is_small(violated) && corrections++ > n + rows)) return true;
        if (violated < 0) continue;
      }
      if (!take(violated)) return false;
    }
    return false;
  }

 private:
  static constexpr double kInfinity = std::numeric_limits<double>::infinity();
  // A constraint whose normal has less than this share outside the active ones depends on them.
  static constexpr double kDependent = 1e-18;
  // Violations below this are rounding, relative to the solution or 1.
  static constexpr double kTolerance = 1e-12;
  // Pivots are at least this share of the diagonal.
  static constexpr double kLeastPivot = 1e-15;
  // From a free minimum that is farther away than this, rounding may leave wrong constraints active.
  static constexpr double kFar = 1e3;
  // A negative multiplier counts as zero up to this, relative to the steepest slope.
  static constexpr double kNegative = 1e-10;
  // A constraint that depends on the active ones may be violated by this much.
  static constexpr double kLoose = 1e-8;

  // Column j of J, contiguous, so that turning two columns and adding one are quick.
  double* J(int j) { return J_.data() + j * n_; }
  double& R(int i, int j) { return R_[i * n_ + j]; }

  // With four sums, as one sum waits for itself.
  static double dot(const double* a, const double* b, int n) {
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    int i = 0;
    for (; i + 3 < n; i += 4)
      for (int k = 0; k < 4; ++k) sums[k] += a[i + k] * b[i + k];
    for (; i < n; ++i) sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
  }
  static void add(double factor, const double* from, double* to, int n) {
    for (int i = 0; i < n; ++i) to[i] += factor * from[i];
  }

  // Factor H = U^T U, and go to the free minimum.
  bool start() {
    const int n = n_;
    J_.assign(n * n, 0.0);
    U_.resize(n * n);
    R_.resize(n * n);
    x.assign(n, 0.0);
    d_.resize(n);
    z_.resize(n);
    r_.resize(n);
    active_.clear();
    multipliers_.clear();
    is_active_.assign(2 * n + rows_, 0);
    is_rounded_ = false;
    row_norms_.resize(rows_);
    for (int k = 0; k < rows_; ++k) row_norms_[k] = std::sqrt(dot(G_ + k * n, G_ + k * n, n));
    for (int k = 0; k < n; ++k) {
      double* row = U_.data() + k * n;
      std::copy(H_ + k * n + k, H_ + k * n + n, row + k);
      for (int i = 0; i < k; ++i) {
        const double* above = U_.data() + i * n;
        add(-above[k], above + k, row + k, n - k);
      }
      // Where targets are 1e18 m away, rounding may leave less than nothing of a pivot.
      const double least = kLeastPivot * H_[k * n + k];
      if (!(least > 0.0 && least < kInfinity)) return false;
      is_rounded_ |= !(row[k] > least);
      const double root = std::sqrt(std::max(row[k], least));
      row[k] = root;
      for (int j = k + 1; j < n; ++j) row[j] /= root;
    }
    // J = U^-1, column by column.
    for (int i = 0; i < n; ++i) {
      double* column = J(i);
      for (int k = 0; k < i; ++k) add(-U_[k * n + i], J(k), column, k + 1);
      column[i] = 1.0;
      const double pivot = U_[i * n + i];
      for (int j = 0; j <= i; ++j) column[j] /= pivot;
    }
    for (int i = 0; i < n; ++i) {  // x = -J J^T c
      const double along = dot(J(i), c_, i + 1);
      if (!(std::abs(along) < kInfinity)) return false;
      add(-along, J(i), x.data(), i + 1);
    }
    is_far_ = false;
    for (const double each : x) is_far_ |= std::abs(each) > kFar;
    return true;
  }

  // How far a constraint is on its right side; negative where it is violated.
  double slack(int k) const {
    if (k < n_) return x[k] - lower_[k];
    if (k < 2 * n_) return upper_[k - n_] - x[k - n_];
    return h_[k - 2 * n_] - dot(G_ + (k - 2 * n_) * n_, x.data(), n_);
  }

  // Whether a constraint, or none, is violated by so little that it may be rounding.
  bool is_small(int violated) const { return violated < 0 || slack(violated) > -kLoose; }

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
      const int i = k < n ? k : k - n;
      const double sign = k < n ? 1.0 : -1.0;
      for (int j = 0; j < n; ++j) d_[j] = sign * J(j)[i];
      return;
    }
    const double* g = G_ + (k - 2 * n) * n;
    for (int j = 0; j < n; ++j) d_[j] = -dot(g, J(j), n);
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
        restore();
        const double length = k < 2 * n ? 1.0 : row_norms_[k - 2 * n];
        double scale = 1.0;
        for (int i = 0; i < n; ++i) scale = std::max(scale, std::abs(x[i]));
        is_active_[k] = 2;
        return slack(k) > -kLoose * scale * length;
      }
      for (int i = 0; i < count; ++i) multipliers_[i] = std::max(multipliers_[i] - t * r_[i], 0.0);
      own += t;
      if (!depends)
        for (int j = count; j < n; ++j) add(t * d_[j], J(j), x.data(), n);
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
    double *a = J(i), *b = J(j);
    for (int k = 0; k < n_; ++k) {
      const double first = a[k], second = b[k];
      a[k] = c * first + s * second;
      b[k] = c * second - s * first;
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

  // Compute the multipliers again, and drop the constraints that hold x from the wrong side. Rounding
  // of the way may leave such. Return whether there were any.
  bool drop_negative() {
    const int n = n_;
    for (bool has_dropped = false;; has_dropped = true) {
      const int count = static_cast<int>(active_.size());
      double steepest = 0.0;
      for (int i = 0; i < n; ++i) {
        z_[i] = c_[i] + dot(H_ + i * n, x.data(), n);
        steepest = std::max(steepest, std::abs(z_[i]));
      }
      int worst = -1;
      double least = -kNegative * steepest;
      for (int i = count - 1; i >= 0; --i) {  // R^-1 J_1^T (H x + c)
        double sum = dot(J(i), z_.data(), n);
        for (int j = i + 1; j < count; ++j) sum -= R(i, j) * r_[j];
        r_[i] = sum / R(i, i);
        const int k = active_[i];
        const double slope = r_[i] * (k < 2 * n ? 1.0 : row_norms_[k - 2 * n]);
        if (slope < least) {
          least = slope;
          worst = i;
        }
      }
      for (int i = 0; i < count; ++i) multipliers_[i] = std::max(r_[i], 0.0);
      if (worst < 0) return has_dropped;
      remove(worst);
      polish();
    }
  }

  // Back onto the active constraints: x += J_1 R^-T (b - N^T x).
  void restore() {
    const int count = static_cast<int>(active_.size());
    for (int i = 0; i < count; ++i) {
      double sum = -slack(active_[i]);
      for (int j = 0; j < i; ++j) sum -= R(j, i) * r_[j];
      r_[i] = sum / R(i, i);
    }
    for (int j = 0; j < count; ++j) add(r_[j], J(j), x.data(), n_);
  }

  // Take out the rounding of the way from a free minimum that may be far away.
  void polish() {
    const int n = n_, count = static_cast<int>(active_.size());
    restore();
    if (is_rounded_) return;
    // And to the minimum along them: x -= J_2 J_2^T (H x + c).
    for (int i = 0; i < n; ++i) z_[i] = c_[i] + dot(H_ + i * n, x.data(), n);
    for (int j = count; j < n; ++j) d_[j] = dot(J(j), z_.data(), n);
    for (int j = count; j < n; ++j) add(-d_[j], J(j), x.data(), n);
  }

  int n_ = 0, rows_ = 0;
  const double *H_ = nullptr, *c_ = nullptr, *lower_ = nullptr, *upper_ = nullptr, *G_ = nullptr,
               *h_ = nullptr;
  std::vector<double> J_, U_, R_, d_, z_, r_, multipliers_, row_norms_;
  std::vector<int> active_;
  std::vector<char> is_active_;
  bool is_rounded_ = false, is_far_ = false;
};

}  // namespace handmap
