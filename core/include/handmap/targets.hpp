// From samples of a human hand to targets of a robot's: see handmap_qp/mapping, whose names these are.
#pragma once

#include <array>
#include <memory>
#include <numeric>

#include "ik.hpp"
#include "method_models.hpp"
#include "person_models.hpp"

namespace handmap {

// The three columns of A turned orthogonal, longest first: A V = U S (Hestenes, 1958).
struct Svd3 {
  Mat3 U, V;  // as rotations up to the sign of the last column, which A decides
  double s[3];
};

inline Svd3 svd3(const Mat3& A) {
  Vec3 a[3] = {A.column(0), A.column(1), A.column(2)};
  Vec3 v[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int sweep = 0; sweep < 30; ++sweep) {
    bool turned = false;
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        const double pp = dot(a[p], a[p]), qq = dot(a[q], a[q]), pq = dot(a[p], a[q]);
        if (!(std::abs(pq) > 1e-15 * std::sqrt(pp * qq))) continue;
        turned = true;
        const double zeta = (qq - pp) / (2.0 * pq);
        const double t = std::copysign(1.0, zeta) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
        const double c = 1.0 / std::sqrt(1.0 + t * t), s = c * t;
        const Vec3 x = a[p], y = v[p];
        a[p] = c * x - s * a[q];
        a[q] = s * x + c * a[q];
        v[p] = c * y - s * v[q];
        v[q] = s * y + c * v[q];
      }
    if (!turned) break;
  }
  int order[3] = {0, 1, 2};
  // By exchanges, which leave NaN where it is: `std::sort` needs an order.
  const auto put_longer_first = [&](int i) {
    if (dot(a[order[i + 1]], a[order[i + 1]]) > dot(a[order[i]], a[order[i]]))
      std::swap(order[i], order[i + 1]);
  };
  for (const int i : {0, 1, 0}) put_longer_first(i);
  Svd3 found;
  Vec3 u[3], w[3];
  for (int i = 0; i < 3; ++i) {
    found.s[i] = norm(a[order[i]]);
    w[i] = v[order[i]];
    u[i] = found.s[i] > 0.0 ? (1.0 / found.s[i]) * a[order[i]] : Vec3{};
  }
  if (found.s[0] == 0.0) u[0] = w[0];
  if (found.s[1] == 0.0) {  // any direction across the first
    const Vec3 other = std::abs(u[0].x) < 0.9 ? Vec3{1, 0, 0} : Vec3{0, 1, 0};
    u[1] = cross(u[0], other);
    u[1] *= 1.0 / norm(u[1]);
  }
  // Both proper: the smallest value takes the sign of the determinant.
  const Vec3 third = cross(u[0], u[1]);
  w[2] = cross(w[0], w[1]);
  found.s[2] = determinant(A) < 0.0 ? -found.s[2] : found.s[2];
  const Vec3 columns_u[3] = {u[0], u[1], third}, columns_w[3] = {w[0], w[1], w[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      found.U(i, j) = columns_u[j][i];
      found.V(i, j) = columns_w[j][i];
    }
  return found;
}

// The rotation nearest to a matrix (Kabsch 1976).
inline Mat3 nearest_rotation(const Mat3& A) {
  const Svd3 found = svd3(A);
  return found.U * transposed(found.V);
}

// The pose that best lays points onto others by their weights; see se3.rigid_fit. `nearest` finds the
// rotation nearest to their covariance.
template <class Nearest>
Pose rigid_fit(const Vec3* points, const Vec3* onto, const Vector& weights, Nearest&& nearest) {
  const size_t count = weights.size();
  double sum = 0.0;
  for (const double weight : weights) sum += weight;
  Vec3 centre, centre_onto;
  for (size_t k = 0; k < count; ++k) {
    centre += (weights[k] / sum) * points[k];
    centre_onto += (weights[k] / sum) * onto[k];
  }
  Mat3 covariance = 0.0 * Mat3{};
  for (size_t k = 0; k < count; ++k)
    covariance =
        covariance + outer((weights[k] / sum) * (onto[k] - centre_onto), points[k] - centre);
  const Mat3 R = nearest(covariance);
  return {R, centre_onto - R * centre};
}
inline Pose rigid_fit(const std::vector<Vec3>& points, const std::vector<Vec3>& onto) {
  return rigid_fit(points.data(), onto.data(), Vector(onto.size(), 1.0), nearest_rotation);
}

// See estimation.MotionEstimator: what a sample's points are multiplied with.
struct Estimator {
  int count = 0;
  Vector moments;  // (7, count)
  Mat3 prior_gain;
  bool has_ridge = false;
  Vec3 centroid;
  std::vector<Vec3> centred;  // the points at the reference, from their centroid

  explicit Estimator(const EstimatorModel& model)
      : count(static_cast<int>(model.shares.size())), moments(model.gain.data),
        prior_gain(model.prior_gain), has_ridge(model.ridge != 0.0), centroid(model.centroid),
        centred(model.centred) {
    // One product gives A^T without the prior, Kabsch's covariance and the centroid of a sample.
    const Vector& shares = model.shares;
    const size_t n = shares.size();
    for (int i = 0; i < 3; ++i)
      for (size_t k = 0; k < n; ++k) moments.push_back(shares[k] * centred[k][i]);
    // The rows of the first two sum to zero, so that they centre the sample as well.
    for (size_t r = 0; r < 6; ++r) {
      double* row = moments.data() + r * n;
      const double sum = std::accumulate(row, row + n, 0.0);
      for (size_t k = 0; k < n; ++k) row[k] -= sum * shares[k];
    }
    moments.insert(moments.end(), shares.begin(), shares.end());
  }

  struct Estimate {
    Mat3 linear;
    Vec3 centroid_after;
    Vec3 image(const Vec3& point, const Vec3& centroid) const {
      return linear * (point - centroid) + centroid_after;
    }
  };

  // `prior` is the rotation that the ridge pulls to; that of the points if it is null.
  Estimate estimate(const Vec3* points, const Mat3* prior) const {
    Vec3 rows[7];
    for (int r = 0; r < 7; ++r)
      for (int k = 0; k < count; ++k) rows[r] += moments[r * count + k] * points[k];
    Estimate found;
    Mat3 covariance;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        found.linear(i, j) = rows[j][i];
        covariance(i, j) = rows[3 + j][i];
      }
    if (has_ridge)
      found.linear = found.linear + (prior ? *prior : nearest_rotation(covariance)) * prior_gain;
    found.centroid_after = rows[6];
    return found;
  }
};

// Numbers for Python, one after the other.
inline void append(const Vector& from, Vector& to) { to.insert(to.end(), from.begin(), from.end()); }
inline void append(const std::vector<Vec3>& from, Vector& to) {
  for (const Vec3& p : from) to.insert(to.end(), {p.x, p.y, p.z});
}
inline void append(const Pose& pose, Vector& to) {
  to.resize(to.size() + 16);
  write_pose(pose, to.data() + to.size() - 16);
}

inline void append(const Vec3& v, Vector& to) { to.insert(to.end(), {v.x, v.y, v.z}); }
inline void append(const Mat3& m, Vector& to) { to.insert(to.end(), m.m, m.m + 9); }

// Shape of an array of Python, of one axis where there are no columns.
struct ArrayShape {
  size_t rows, columns = 0;
};

// The targets of one hand for one sample, and the numbers that its diagnostics are made of.
struct Targets {
  std::vector<Vec3> points;
  Pose wrist;
  Vector rest;  // joint positions that the QP's rest term pulls to
  const DistanceTask* distances = nullptr;
  Vector aims, weights, margins, diagnostics;
  // Share of the weights of the rest term and of the damping, of each joint; null for all of both.
  const Vector* regularisation = nullptr;
  bool is_clamped = false;

  // Memory that a map works in: maps are shared by threads, and targets are one thread's.
  struct Work {
    std::vector<Vec3> now;       // the person's points in palm axes
    std::vector<Vec3> shape;     // those of them that the shape is estimated from
    std::vector<Vec3> residual;  // what the imposed motion leaves of the points
    Vector extensions, gaps, pinching, shares;
  } work;
};

// The distances of a model.
inline DistanceTask task_of(const DistancesModel& model) {
  DistanceTask task{{}, model.first, model.second};
  for (size_t k = 0; k < model.joints.size(); ++k)
    task.points.push_back({model.joints[k], model.offsets[k]});
  return task;
}

// How a robot's palm follows the human's: see palm.PalmMap.
struct PalmMap : PalmModel {
  // The target of the robot's palm for the human's.
  Pose follow(const Pose& human) const {
    if (is_still) return start;
    Pose palm{human.R * rotation, human * origin + offset};
    if (further != 0.0) palm.p += further * (human * human_anchor - human_start);
    return {alignment * palm.R, alignment * palm.p};
  }

  // The human's palm in the robot's world, about its anchor.
  Pose person_at(const Pose& wrist) const {
    const Pose palm = wrist * human_wrist_to_palm;
    return {alignment * palm.R, alignment * ((1.0 + further) * (palm * human_anchor))};
  }
};

// Share of a line segment at which it is nearest to a point.
inline double nearest_share(const Vec3& point, const Vec3& from, const Vec3& along) {
  const double length2 = dot(along, along);
  return length2 > 0.0 ? clip(dot(point - from, along) / length2, 0.0, 1.0) : 0.0;
}

// A vector turned as one direction must be to become another one; beyond 154 degrees it is shortened
// instead, because opposite directions do not say which way to turn.
inline Vec3 turned_with(const Vec3& vector, const Vec3& from, const Vec3& to) {
  const double lengths = norm(from) * norm(to);
  if (!(lengths > 0.0)) return vector;
  const Vec3 axis = (1.0 / lengths) * cross(from, to);
  const double cosine = std::max(dot(from, to) / lengths, -0.9);
  return vector + cross(axis, vector) + (1.0 / (1.0 + cosine)) * cross(axis, cross(axis, vector));
}

// Go from 0 to 1 with no slope at either end; see se3.smoothstep.
inline double smoothstep(double x) {
  x = clip(x, 0.0, 1.0);
  return x * x * (3.0 - 2.0 * x);
}

class TargetMap {
 public:
  TargetMap(const EstimatorModel& model, Vector rest, size_t human_points, bool needs_wrist)
      : estimator(model), human_points(human_points), needs_wrist(needs_wrist),
        rest(std::move(rest)) {}
  virtual ~TargetMap() = default;
  virtual void targets(const std::vector<Vec3>& points, const Pose* wrist, Targets& targets) const = 0;
  // How the palm follows; null for methods that move it otherwise.
  virtual const PalmMap* palm() const { return nullptr; }
  // The distances that are asked for; null for none.
  virtual const DistanceTask* distances() const { return nullptr; }
  // The arrays that the diagnostics of a sample are, one after the other.
  virtual std::vector<ArrayShape> shapes() const = 0;

  const Estimator estimator;
  const size_t human_points;
  const bool needs_wrist;
  const Vector rest;  // joint positions that the rest term pulls to where a sample does not say

  // RMS distance of the human points from where T takes them [m]. The diagnostics of every map begin
  // with T's linear part, the centroid after the motion and the points after it.
  double residual(const Targets& targets) const {
    const double* from = targets.diagnostics.data();
    Mat3 linear;
    std::copy(from, from + 9, linear.m);
    const Vec3 centroid{from[9], from[10], from[11]};
    from += 12;
    double sum = 0.0;
    for (const Vec3& before : estimator.centred) {
      const Vec3 after = Vec3{from[0], from[1], from[2]} - centroid;
      const Vec3 off = after - linear * before;
      sum += dot(off, off);
      from += 3;
    }
    return std::sqrt(sum / static_cast<double>(estimator.centred.size()));
  }
};

// See methods.teleoperation.TeleoperationMap; reference/teleoperation_targets.py has it in Python.
class TeleoperationMap : public TargetMap {
 public:
  TeleoperationMap(TeleoperationModel model, PalmMap palm)
      : TargetMap(model.estimator, model.rest, static_cast<size_t>(model.human_points), true),
        model_(std::move(model)), palm_(std::move(palm)), distances_(task_of(model_.distances)) {}

  const PalmMap* palm() const override { return &palm_; }
  const DistanceTask* distances() const override { return &distances_; }
  std::vector<ArrayShape> shapes() const override {
    const TeleoperationModel& of = model_;
    const size_t fingers = of.human_reach.size(), pinches = of.from_points.size() - fingers;
    return {{3, 3},    {3},       {of.shape_points.size(), 3}, {4, 4},
            {pinches}, {pinches}, {fingers},                   {rest.size()}};
  }

  void targets(const std::vector<Vec3>& points, const Pose* wrist, Targets& targets) const override {
    const TeleoperationModel& of = model_;
    const Pose human = *wrist * palm_.human_wrist_to_palm, to_palm = inverse(human);
    auto& [now, shape, residual, extensions, gaps, pinching, shares] = targets.work;
    now.resize(points.size());
    shape.resize(of.shape_points.size());
    for (size_t k = 0; k < points.size(); ++k) now[k] = to_palm * points[k];
    const Pose palm = palm_.follow(human);
    for (size_t k = 0; k < shape.size(); ++k) shape[k] = now[of.shape_points[k]];
    const Estimator::Estimate estimate = estimator.estimate(shape.data(), nullptr);
    const size_t rows = of.from_points.size(), fingers = of.human_reach.size();
    const size_t pinches = rows - fingers;
    extensions.resize(fingers);
    gaps.resize(pinches);
    pinching.resize(pinches);
    targets.distances = &distances_;
    targets.regularisation = &of.regularisation;
    targets.aims.resize(rows);
    targets.weights.resize(rows);
    for (size_t k = 0; k < rows; ++k) {
      const double distance = norm(now[of.to_points[k]] - now[of.from_points[k]]);
      targets.aims[k] = std::min(std::max(of.aim_slopes[k] * distance + of.aim_offsets[k], of.least_aims[k]),
                               of.largest_aims[k]);
      if (k < fingers) {
        extensions[k] = distance / of.human_reach[k];
        targets.weights[k] = of.extension_weights[k];
      } else {
        const size_t p = k - fingers;
        gaps[p] = distance;
        pinching[p] = pinch_share(distance, extensions[p + 1]);
        targets.weights[k] = of.pinch_weight * pinching[p];
      }
    }
    rest_for(gaps, shares, targets.rest);
    const Vec3 shift = estimate.centroid_after;
    double most = 0.0;
    for (const double share : pinching) most = std::max(most, share);
    targets.points.resize(of.partners.size());
    for (size_t j = 0; j < of.partners.size(); ++j) {
      Vec3 moved = estimate.linear * of.offsets[j] + of.robot_centre +
                   of.ratio * (shift - estimator.centroid) + of.gain * (now[of.partners[j]] - shift);
      // Away from a pinch, fingers point as the human's do.
      const int f = of.finger_of[j];
      const double closing = pinches == 0 ? 0.0 : f == 0 ? most : pinching[f - 1];
      const Vec3 led = of.bases[j] + of.ratios[j] * (now[of.partners[j]] - now[of.starts[j]]) +
                       of.carried[j] * now[of.starts[j]];
      moved += of.directions[j] * (1.0 - (1.0 - of.likeness) * closing) * (led - moved);
      targets.points[j] = moved;
    }
    double lying = 0.0;
    if (pinches > 0) {
      const Thumb thumb = lie_on_finger(now, gaps, targets.points);
      open_thumb(thumb.away, extensions[0], targets.aims[0]);
      // The segment says where the thumb is, and the thumb may touch it.
      lying = thumb.lying;
      targets.weights[0] *= 1.0 - (1.0 - of.lying_extension) * lying;
    }
    for (Vec3& point : targets.points) point = palm * point;
    targets.wrist = palm * palm_.robot_palm_to_wrist;
    targets.margins = of.base_margins;
    for (size_t i = 0; i < of.pinch_pairs.size(); ++i) {
      const double wide = of.contact_slope * (gaps[of.pinch_of_pair[i]] - of.contact_from);
      targets.margins[of.pinch_pairs[i]] =
          of.pinch_margins[i] + (1.0 - lying) * std::min(std::max(wide, 0.0), of.contact_most);
    }
    Vector& to_python = targets.diagnostics;
    to_python.clear();
    append(estimate.linear, to_python);
    append(estimate.centroid_after, to_python);
    append(shape, to_python);
    append(human, to_python);
    append(gaps, to_python);
    append(pinching, to_python);
    append(extensions, to_python);
    append(targets.rest, to_python);
  }

 private:
  // Share of its weight that a pinch row has. A straight finger hardly pinches: its row begins later.
  double pinch_share(double gap, double extension) const {
    const TeleoperationModel& of = model_;
    const double less = of.straight_less * smoothstep((extension - of.straight_from) / of.straight_over);
    return smoothstep((of.pinch_from - less - gap) / (of.pinch_over - less));
  }

  // A person's thumb: distance of its tip from all segments of the fingers, and how far it lies on one.
  struct Thumb {
    double away, lying;
  };

  // A thumb that is away from all fingers is as straight as the person's, whatever it is at rest.
  void open_thumb(double away, double extension, double& aim) const {
    const TeleoperationModel& of = model_;
    const double straight = of.largest_aims[0] * std::min(extension, 1.0);
    aim += smoothstep((away - of.open_from) / of.open_over) * (straight - aim);
  }

  // A thumb that lies on a segment of the person's fingers lies on the same one of the robot's, on
  // the same side, as far away as both are thick.
  Thumb lie_on_finger(const std::vector<Vec3>& now, const Vector& gaps,
                      std::vector<Vec3>& points) const {
    const TeleoperationModel& of = model_;
    const Vec3& tip = now[of.to_points[0]];
    double away = kInfinity, lying = 0.0, total = 0.0;
    Vec3 places;
    for (size_t k = 0; k < of.segment_starts.size(); ++k) {
      const Vec3 &from = now[of.segment_starts[k]], along = now[of.segment_ends[k]] - from;
      const double share = nearest_share(tip, from, along);
      const Vec3 off = tip - (from + share * along);
      const double distance = norm(off);
      away = std::min(away, distance);
      const double near = smoothstep((of.lying_from - distance) / of.lying_over);
      if (!(near > 0.0)) continue;
      const Vec3 start = of.segment_from[k] < 0 ? of.segment_bases[k] : points[of.segment_from[k]];
      const Vec3 robot = points[of.segment_to[k]] - start;
      const double wanted = of.segment_touching[k] + std::max(distance - of.skin_gap, 0.0);
      // Across the segment, where noise decides the side, the way from it shrinks to nothing.
      const double least = std::max(distance, std::max(0.5 * of.skin_gap, kSkin));
      const Vec3 place = start + share * robot + (wanted / least) * turned_with(off, along, robot);
      // Nearer segments count much more, and none takes over at once.
      const double weight = near / std::pow(std::max(distance, kSkin), 4.0);
      places += weight * place;
      total += weight;
      lying = std::max(lying, near);
    }
    double tips = kInfinity;
    for (const double gap : gaps) tips = std::min(tips, gap);
    // The row of a pinch leads a tip to a tip.
    lying *= of.lying_weight * smoothstep((tips - of.tips_from) / of.tips_over);
    if (!(lying > 0.0)) return {away, 0.0};
    const Vec3 shift = lying * ((1.0 / total) * places - points[0]);
    for (size_t j = 0; j < points.size(); ++j)
      if (of.finger_of[j] == 0) points[j] += shift;
    return {away, lying};
  }

  // As a pinch closes, the rest posture becomes the one that closes it, so that thumb and finger come
  // to each other by the same way from anywhere.
  void rest_for(const Vector& gaps, Vector& shares, Vector& found) const {
    const TeleoperationModel& of = model_;
    found = of.rest;
    shares.resize(gaps.size());
    double total = 0.0;
    for (size_t p = 0; p < gaps.size(); ++p) {
      shares[p] = smoothstep((of.rest_from - gaps[p]) / of.rest_over);
      total += shares[p];
    }
    total = std::max(total, 1.0);
    for (size_t p = 0; p < gaps.size(); ++p)
      for (size_t i = 0; i < found.size(); ++i)
        found[i] += shares[p] / total * of.pinch_rests.row(p)[i];
  }

  // Bones of a person are no nearer to each other [m].
  static constexpr double kSkin = 1e-3;

  const TeleoperationModel model_;
  const PalmMap palm_;
  const DistanceTask distances_;
};

// See methods.homogeneous.HomogeneousMap; reference/targets.py has it in Python.
class HomogeneousMap : public TargetMap {
 public:
  explicit HomogeneousMap(const HomogeneousModel& model)
      : TargetMap(model.estimator, model.rest, model.estimator.shares.size(),
                  model.rigid_from == "wrist"),
        model_(model),
        rigid_(model.rigid_from == "wrist"  ? Rigid::wrist
               : model.rigid_from == "none" ? Rigid::none
                                            : Rigid::points) {
    if (model.human_wrist) human_wrist_ = *model.human_wrist;
  }

  std::vector<ArrayShape> shapes() const override {
    return {{3, 3}, {3}, {human_points, 3}, {3, 3}, {3, 3}, {3}, {3}, {3}};
  }

  void targets(const std::vector<Vec3>& points, const Pose* wrist, Targets& targets) const override {
    const Mat3& Q = model_.alignment;
    const Vec3& pivot = model_.pivot;
    const double gain = model_.deformation_gain;
    Mat3 turn;
    if (rigid_ == Rigid::wrist) turn = wrist->R * transposed(human_wrist_.R);
    const Estimator::Estimate estimate =
        estimator.estimate(points.data(), rigid_ == Rigid::wrist ? &turn : nullptr);
    Mat3 linear = estimate.linear;
    const Vec3 image = estimate.image(pivot, estimator.centroid);
    const Svd3 factors = svd3(linear);
    const Mat3 R = factors.U * transposed(factors.V);
    Vec3 stretches{factors.s[0], factors.s[1], factors.s[2]}, wanted = stretches;
    for (int i = 0; i < 3; ++i) wanted[i] = std::min(std::max(wanted[i], model_.stretch_min), model_.stretch_max);
    targets.is_clamped = wanted.x != stretches.x || wanted.y != stretches.y || wanted.z != stretches.z;
    if (targets.is_clamped || gain != 1.0) {
      Mat3 stretch = 0.0 * Mat3{};
      for (int i = 0; i < 3; ++i) {
        const Vec3 axis = factors.U.column(i);
        stretch = stretch + std::pow(wanted[i], gain) * outer(axis, axis);
      }
      linear = stretch * R;
    }
    Mat3 rotation;
    Vec3 rigid_image = pivot;
    if (rigid_ == Rigid::points) {
      rotation = R;
      rigid_image = image;
    } else if (rigid_ == Rigid::wrist) {
      rotation = turn;
      rigid_image = turn * (pivot - human_wrist_.p) + wrist->p;
    }
    const Mat3 imposed = Q * linear * transposed(Q);
    const Vec3 centre = placed(image);
    targets.points.resize(model_.robot_offsets.size());
    for (size_t j = 0; j < model_.robot_offsets.size(); ++j)
      targets.points[j] = imposed * model_.robot_offsets[j] + centre;
    if (!model_.share.data.empty()) {
      // The residual refers to the imposed motion, so it makes up for clamping and gain.
      const size_t count = points.size();
      std::vector<Vec3>& residual = targets.work.residual;
      residual.resize(count);
      for (size_t k = 0; k < count; ++k)
        residual[k] = points[k] - (linear * model_.human_offsets[k] + image);
      for (size_t j = 0; j < targets.points.size(); ++j) {
        Vec3 sum;
        for (size_t k = 0; k < count; ++k) sum += model_.share.row(j)[k] * residual[k];
        targets.points[j] += Q * sum;
      }
    }
    targets.wrist = Pose{Q * rotation * transposed(Q), placed(rigid_image)} * model_.robot_wrist;
    targets.rest = rest;
    Vector& to_python = targets.diagnostics;
    to_python.clear();
    append(estimate.linear, to_python);
    append(estimate.centroid_after, to_python);
    append(points, to_python);
    append(linear, to_python);
    append(rotation, to_python);
    append(rigid_image, to_python);
    append(image, to_python);
    append(stretches, to_python);
  }

 private:
  enum class Rigid { points, wrist, none };
  const HomogeneousModel model_;
  const Rigid rigid_;
  Pose human_wrist_;  // at the reference

  Vec3 placed(const Vec3& image) const {
    return model_.origin + model_.scale * (model_.alignment * image);
  }
};

}  // namespace handmap
