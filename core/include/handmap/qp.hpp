// A dual active-set method for small dense problems (Goldfarb and Idnani, Math. Prog. 27, 1983):
//
//   min  1/2 x^T H x + c^T x   s.t.   lower <= x <= upper,   G x <= h,    H positive definite.
//
// It starts from the free minimum and takes in one violated constraint after the other. H = L^T L, with
// L lower triangular, and L^-T N = Q R, with the normals N of the active constraints. Few are active,
// so Q has few columns (Daniel, Gragg, Kaufman and Stewart, Math. Comp. 30, 1976).
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

// GCC compiles a function, and all that it calls, a second time for wide registers; a processor that
// has them runs that version. Nothing rounds differently. Clang refuses the two attributes together,
// and one without the other gains nothing, so it compiles the function once.
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__) && \
    defined(__gnu_linux__)
#define HANDMAP_WIDE __attribute__((target_clones("avx2", "default"), flatten))
#else
#define HANDMAP_WIDE
#endif

namespace handmap {

class Qp {
 public:
  std::vector<double> x;
  int iterations = 0;

  // Return whether a minimum was found; of H, the lower triangle counts. G has `rows` rows, one after
  // the other. With `is_same_cost`, H and c have the numbers of the last call, which factored H. The
  // constraints `expected` are thought to be active; it costs time if they are not.
  HANDMAP_WIDE bool solve(int n, const double* H, const double* c, const double* lower, const double* upper,
             int rows, const double* G, const double* h, bool is_same_cost = false,
             const std::vector<int>& expected = {}) {
    n_ = n;
    rows_ = rows;
    lower_ = lower;
    upper_ = upper;
    G_ = G;
    h_ = h;
    H_ = H;
    c_ = c;
    if (!is_same_cost) has_factors_ = factor();
    if (!has_factors_) return false;
    start();
    if (!expected.empty()) start_from(expected);
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

  // Make room for problems of up to so many coordinates and rows.
  void reserve(size_t n, size_t rows) {
    for (std::vector<double>* each : {&x, &free_minimum_, &inverse_, &d_, &w_, &v_, &r_, &multipliers_})
      each->reserve(n);
    for (std::vector<double>* each : {&L_, &Q_, &R_}) each->reserve(n * n);
    active_.reserve(n);
    is_active_.reserve(2 * n + rows);
    row_norms_.reserve(rows);
  }

  // The constraints that hold the minimum: i for the lower bound of coordinate i, n + i for the upper one,
  // 2 n + r for row r.
  const std::vector<int>& active() const { return active_; }

  // Whether a row holds the minimum.
  bool has_active_row() const {
    return std::any_of(active_.begin(), active_.end(), [this](int k) { return k >= 2 * n_; });
  }

  // Whether a row is violated that no coordinate moves, or that depends on the active constraints.
  bool leaves_any() const {
    for (int r = 0; r < rows_; ++r)
      if (is_active_[2 * n_ + r] == 2 || (!holds_any(r) && h_[r] < 0.0)) return true;
    return false;
  }

  // Add multipliers times rows, here those of `G` with n coordinates.
  void add_rows(const double* G, int n, double* to) const {
    for (size_t i = 0; i < active_.size(); ++i)
      if (active_[i] >= 2 * n_) add(multipliers_[i], G + (active_[i] - 2 * n_) * n, to, n);
  }

  // Add H x to a vector; of H, the lower triangle counts.
  static void add_product(int n, const double* H, const double* x, double* to) {
    for (int i = 0; i < n; ++i) {
      if (x[i] == 0.0) {
        to[i] += dot(H + i * n, x, i);
        continue;
      }
      to[i] += dot(H + i * n, x, i + 1);
      add(x[i], H + i * n, to, i);
    }
  }

  // With four sums, as one sum waits for itself.
  static double dot(const double* a, const double* b, int n) {
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    int i = 0;
    for (; i + 3 < n; i += 4)
      for (int k = 0; k < 4; ++k) sums[k] += a[i + k] * b[i + k];
    for (; i < n; ++i) sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
  }

 private:
  static constexpr double kInfinity = std::numeric_limits<double>::infinity();
  // A constraint whose normal has less than this share outside the active ones depends on them.
  static constexpr double kDependent = 1e-18;
  // Of constraints that are expected to be active, those count that have this share outside the others.
  static constexpr double kIndependent = 1e-8;
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

  double* L(int i) { return L_.data() + i * n_; }
  double* Q(int j) { return Q_.data() + j * n_; }
  double& R(int i, int j) { return R_[i * n_ + j]; }

  static void add(double factor, const double* from, double* to, int n) {
    for (int i = 0; i < n; ++i) to[i] += factor * from[i];
  }

  // Factor H = L^T L, and find the free minimum. False if H is not positive definite.
  bool factor() {
    const int n = n_;
    L_.resize(n * n);
    for (std::vector<double>* part : {&x, &inverse_, &w_}) part->resize(n);
    is_rounded_ = false;
    for (int k = 0; k < n; ++k) std::copy(H_ + k * n, H_ + k * n + k + 1, L(k));
    // From the last coordinate to the first: along a tree, zeros of H stay zeros of L (Featherstone,
    // Int. J. Robotics Res. 24, 2005).
    for (int k = n - 1; k >= 0; --k) {
      double* row = L(k);
      // Where targets are 1e18 m away, rounding may leave less than nothing of a pivot.
      const double least = kLeastPivot * H_[k * n + k];
      if (!(least > 0.0 && least < kInfinity)) return false;
      is_rounded_ |= !(row[k] > least);
      row[k] = std::sqrt(std::max(row[k], least));
      inverse_[k] = 1.0 / row[k];
      for (int i = 0; i < k; ++i) row[i] *= inverse_[k];
      for (int i = 0; i < k; ++i)
        if (row[i] != 0.0) add(-row[i], row, L(i), i + 1);
    }
    for (int i = 0; i < n; ++i) w_[i] = -c_[i];
    solve_transposed(w_.data());
    for (int i = 0; i < n; ++i)
      if (!(std::abs(w_[i]) < kInfinity)) return false;
    solve_lower(w_.data());
    free_minimum_ = w_;
    is_far_ = false;
    for (const double each : free_minimum_) is_far_ |= std::abs(each) > kFar;
    return true;
  }

  // Go to the free minimum, where no constraint is active.
  void start() {
    const int n = n_;
    x = free_minimum_;
    Q_.resize(n * n);
    R_.resize(n * n);
    for (std::vector<double>* part : {&d_, &v_, &r_}) part->resize(n);
    active_.clear();
    multipliers_.clear();
    is_active_.assign(2 * n + rows_, 0);
    row_norms_.resize(rows_);
    for (int k = 0; k < rows_; ++k) row_norms_[k] = std::sqrt(dot(G_ + k * n, G_ + k * n, n));
  }

  // Start from the minimum along constraints that are expected to be active, without those that would
  // hold it from the wrong side. The method goes on from any such minimum.
  void start_from(const std::vector<int>& expected) {
    for (const int k : expected) {
      const int count = static_cast<int>(active_.size());
      if (count == n_) break;
      if (k >= 2 * n_ && !holds_any(k - 2 * n_)) continue;
      set_normal(k);
      v_ = w_;
      leave_active(v_.data());
      const double free = dot(v_.data(), v_.data(), n_);
      if (free > kIndependent * dot(w_.data(), w_.data(), n_)) append(k, 0.0, std::sqrt(free));
    }
    while (!active_.empty()) {
      const int count = static_cast<int>(active_.size());
      x = free_minimum_;
      restore();
      // From L^-T N = Q R and the way from the free minimum, L^-1 Q r, multipliers are R^-1 r.
      for (int i = count - 1; i >= 0; --i) {
        double sum = r_[i];
        for (int j = i + 1; j < count; ++j) sum -= R(i, j) * multipliers_[j];
        multipliers_[i] = sum / R(i, i);
      }
      bool is_any_negative = false;
      for (int i = count - 1; i >= 0; --i) {
        if (multipliers_[i] >= 0.0) continue;
        remove(i);
        is_any_negative = true;
      }
      if (!is_any_negative) return;
    }
    x = free_minimum_;
  }

  // y = L^-T y
  void solve_transposed(double* y) {
    for (int k = n_ - 1; k >= 0; --k) {
      if (y[k] == 0.0) continue;
      y[k] *= inverse_[k];
      add(-y[k], L(k), y, k);
    }
  }

  // y = L^-1 y
  void solve_lower(double* y) {
    for (int k = 0; k < n_; ++k) y[k] = (y[k] - dot(L(k), y, k)) * inverse_[k];
  }

  // Take from v its part in the span of Q, to which `d_` adds up.
  void leave_active(double* v) {
    const int count = static_cast<int>(active_.size());
    std::fill(d_.begin(), d_.begin() + count, 0.0);
    for (int pass = 0; pass < 2; ++pass)  // twice is enough for rounding
      for (int j = 0; j < count; ++j) {
        const double along = dot(Q(j), v, n_);
        d_[j] += along;
        add(-along, Q(j), v, n_);
      }
  }

  // How far a constraint is on its right side; negative where it is violated.
  double slack(int k) const {
    if (k < n_) return x[k] - lower_[k];
    if (k < 2 * n_) return upper_[k - n_] - x[k - n_];
    return h_[k - 2 * n_] - dot(G_ + (k - 2 * n_) * n_, x.data(), n_);
  }

  // Whether a row holds any coordinate.
  bool holds_any(int row) const { return !(row_norms_[row] < 1e-12); }

  // Whether a constraint, or none, is violated by so little that it may be rounding.
  bool is_small(int violated) const { return violated < 0 || slack(violated) > -kLoose; }

  int most_violated() const {
    double scale = 1.0;
    for (int i = 0; i < n_; ++i) scale = std::max(scale, std::abs(x[i]));
    int found = -1;
    double worst = -kTolerance * scale;
    const auto consider = [&](int k, double s) {
      if (!(s < worst) || is_active_[k]) return;
      worst = s;
      found = k;
    };
    for (int i = 0; i < n_; ++i) consider(i, x[i] - lower_[i]);
    for (int i = 0; i < n_; ++i) consider(n_ + i, upper_[i] - x[i]);
    for (int r = 0; r < rows_; ++r)
      if (holds_any(r))
        consider(2 * n_ + r, slack(2 * n_ + r) / row_norms_[r]);
    return found;
  }

  // w = L^-T normal
  void set_normal(int k) {
    const int n = n_;
    if (k < 2 * n) {
      std::fill(w_.begin(), w_.end(), 0.0);
      w_[k < n ? k : k - n] = k < n ? 1.0 : -1.0;
    } else {
      const double* g = G_ + (k - 2 * n) * n;
      for (int i = 0; i < n; ++i) w_[i] = -g[i];
    }
    solve_transposed(w_.data());
  }

  // Take in a violated constraint; drop others on the way. False if it contradicts them.
  bool take(int k) {
    const int n = n_;
    double own = 0.0;
    set_normal(k);
    const double all = dot(w_.data(), w_.data(), n);
    while (true) {
      const int count = static_cast<int>(active_.size());
      v_ = w_;
      leave_active(v_.data());
      const double free = dot(v_.data(), v_.data(), n);
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
      if (full <= drop_at) append(k, own, std::sqrt(free));
      if (!depends) {
        solve_lower(v_.data());
        add(t, v_.data(), x.data(), n);
      }
      if (full <= drop_at) {
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

  // Turn two columns of Q.
  void turn(int i, int j, double c, double s) {
    double *a = Q(i), *b = Q(j);
    for (int k = 0; k < n_; ++k) {
      const double first = a[k], second = b[k];
      a[k] = c * first + s * second;
      b[k] = c * second - s * first;
    }
  }

  // Take in a constraint; `free` is the length of what its normal has outside the active ones, v.
  void append(int k, double multiplier, double free) {
    const int count = static_cast<int>(active_.size());
    for (int i = 0; i < count; ++i) R(i, count) = d_[i];
    R(count, count) = free;
    for (int i = 0; i < n_; ++i) Q(count)[i] = v_[i] / free;
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
      find_slope();
      double steepest = 0.0;
      for (const double each : v_) steepest = std::max(steepest, std::abs(each));
      solve_transposed(v_.data());
      int worst = -1;
      double least = -kNegative * steepest;
      for (int i = count - 1; i >= 0; --i) {  // R^-1 Q^T L^-T (H x + c)
        double sum = dot(Q(i), v_.data(), n);
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

  // v = H x + c
  void find_slope() {
    std::copy(c_, c_ + n_, v_.begin());
    add_product(n_, H_, x.data(), v_.data());
  }

  // Back onto the active constraints: x += L^-1 Q R^-T (b - N^T x).
  void restore() {
    const int n = n_, count = static_cast<int>(active_.size());
    std::fill(v_.begin(), v_.end(), 0.0);
    for (int i = 0; i < count; ++i) {
      double sum = -slack(active_[i]);
      for (int j = 0; j < i; ++j) sum -= R(j, i) * r_[j];
      r_[i] = sum / R(i, i);
      add(r_[i], Q(i), v_.data(), n);
    }
    if (count > 0) {
      solve_lower(v_.data());
      add(1.0, v_.data(), x.data(), n);
    }
  }

  // Take out the rounding of the way from a free minimum that may be far away.
  void polish() {
    restore();
    if (is_rounded_) return;
    // And to the minimum along them: x -= L^-1 (I - Q Q^T) L^-T (H x + c).
    find_slope();
    solve_transposed(v_.data());
    leave_active(v_.data());
    solve_lower(v_.data());
    add(-1.0, v_.data(), x.data(), n_);
  }

  int n_ = 0, rows_ = 0;
  const double *H_ = nullptr, *c_ = nullptr, *lower_ = nullptr, *upper_ = nullptr, *G_ = nullptr,
               *h_ = nullptr;
  std::vector<double> free_minimum_, L_, inverse_, Q_, R_, d_, w_, v_, r_, multipliers_, row_norms_;
  std::vector<int> active_;
  std::vector<char> is_active_;
  bool has_factors_ = false, is_rounded_ = false, is_far_ = false;
};

}  // namespace handmap
