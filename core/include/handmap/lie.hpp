// Exponentials and logarithms of SO(3) and SE(3), as Pinocchio has them: twists linear first.
#pragma once

#include <algorithm>
#include <limits>

#include "vector.hpp"

namespace handmap {

struct Twist {
  Vec3 v, w;
};

struct Quat {
  double x = 0.0, y = 0.0, z = 0.0, w = 1.0;
};

// Below this angle, series take the place of quotients that lose digits [rad].
constexpr double kSmall = 1e-3;

inline Mat3 rotation_of(const Quat& q) {
  const double x = 2 * q.x, y = 2 * q.y, z = 2 * q.z;
  const double wx = x * q.w, wy = y * q.w, wz = z * q.w, xx = x * q.x, xy = y * q.x, xz = z * q.x;
  const double yy = y * q.y, yz = z * q.y, zz = z * q.z;
  return {{1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx,
           1 - (xx + yy)}};
}

inline Quat quat_of(const Mat3& R) {
  const double trace = R(0, 0) + R(1, 1) + R(2, 2);
  double c[4];
  if (trace > 0.0) {
    double t = std::sqrt(trace + 1.0);
    c[3] = 0.5 * t;
    t = 0.5 / t;
    c[0] = (R(2, 1) - R(1, 2)) * t;
    c[1] = (R(0, 2) - R(2, 0)) * t;
    c[2] = (R(1, 0) - R(0, 1)) * t;
  } else {
    int i = R(1, 1) > R(0, 0) ? 1 : 0;
    if (R(2, 2) > R(i, i)) i = 2;
    const int j = (i + 1) % 3, k = (j + 1) % 3;
    double t = std::sqrt(std::max(R(i, i) - R(j, j) - R(k, k) + 1.0, 0.0));
    c[i] = 0.5 * t;
    t = t > 0.0 ? 0.5 / t : 0.0;
    c[3] = (R(k, j) - R(j, k)) * t;
    c[j] = (R(j, i) + R(i, j)) * t;
    c[k] = (R(k, i) + R(i, k)) * t;
  }
  return {c[0], c[1], c[2], c[3]};
}

// The quaternion of a rotation vector.
inline Quat quat_exp(const Vec3& w) {
  const double angle2 = dot(w, w), angle = std::sqrt(angle2);
  const double s = angle < kSmall ? 0.5 - angle2 / 48.0 * (1.0 - angle2 / 80.0)
                                  : std::sin(0.5 * angle) / angle;
  return {s * w.x, s * w.y, s * w.z, std::cos(0.5 * angle)};
}

inline Quat operator*(const Quat& a, const Quat& b) {
  return {a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y + a.y * b.w + a.z * b.x - a.x * b.z,
          a.w * b.z + a.z * b.w + a.x * b.y - a.y * b.x,
          a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z};
}

inline Mat3 exp3(const Vec3& w) { return rotation_of(quat_exp(w)); }

// The rotation vector of a rotation.
inline Vec3 log3(const Mat3& R) {
  const Quat q = quat_of(R);
  const Vec3 v{q.x, q.y, q.z};
  const double s = norm(v), sign = q.w < 0.0 ? -1.0 : 1.0;
  const double c = sign * q.w;
  // Of the half angle: 2 atan(s / c) / s.
  const double factor =
      s < kSmall ? 2.0 / c * (1.0 - s * s / (3.0 * c * c) * (1.0 - 0.6 * s * s / (c * c)))
                 : 2.0 * std::atan2(s, c) / s;
  return (sign * factor) * v;
}

// Factors of the inverse left Jacobian V^-1 = a I - 1/2 [w] + b w w^T of SO(3).
struct LogFactors {
  double a, b;
};
inline LogFactors log_factors(double t) {
  const double t2 = t * t;
  if (t < 1e-2) {
    const double b = 1.0 / 12.0 + t2 / 720.0 + t2 * t2 / 30240.0;
    return {1.0 - t2 * b, b};
  }
  const double a = t * std::sin(t) / (2.0 * (1.0 - std::cos(t)));
  return {a, (1.0 - a) / t2};
}

inline Twist log6(const Pose& m) {
  const Vec3 w = log3(m.R);
  const LogFactors f = log_factors(norm(w));
  return {f.a * m.p - 0.5 * cross(w, m.p) + (f.b * dot(w, m.p)) * w, w};
}

// Derivative of log6(M exp6(x)) at x = 0: [[A, B], [0, A]].
struct LogJacobian {
  Mat3 A, B;
};
inline LogJacobian jlog6(const Pose& m) {
  const Vec3 w = log3(m.R), p = m.p;
  const double t2 = dot(w, w), t = std::sqrt(t2);
  const LogFactors f = log_factors(t);
  const Mat3 eye;
  const Mat3 A = f.a * eye + 0.5 * skew(w) + f.b * outer(w, w);
  // b' / t, the change of b with the angle.
  double db;
  if (t < 1e-2) {
    db = 1.0 / 360.0 + t2 / 7560.0;
  } else {
    const double half = 1.0 / (2.0 * (1.0 - std::cos(t)));
    db = (-2.0 / t2 + (1.0 + std::sin(t) / t) * half) / t2;
  }
  const double along = dot(w, p);
  const Vec3 u = (db * along) * w - (t2 * db + 2.0 * f.b) * p;
  const Mat3 C = outer(u, w) + f.b * outer(w, p) + (along * f.b) * eye + 0.5 * skew(p);
  return {A, C * A};
}

// The translation of exp6.
inline Vec3 exp6_translation(const Twist& x) {
  const double t2 = dot(x.w, x.w), t = std::sqrt(t2);
  double a, b;  // (1 - cos t) / t^2, (t - sin t) / t^3
  if (t < 1e-2) {
    a = 0.5 - t2 / 24.0 * (1.0 - t2 / 30.0);
    b = 1.0 / 6.0 - t2 / 120.0 * (1.0 - t2 / 42.0);
  } else {
    a = (1.0 - std::cos(t)) / t2;
    b = (t - std::sin(t)) / (t2 * t);
  }
  return x.v + a * cross(x.w, x.v) + b * cross(x.w, cross(x.w, x.v));
}

}  // namespace handmap
