// Methods as models; see models/method.py, which says what their fields are.
#pragma once

#include "model_reader.hpp"

namespace handmap {

// The linear motion T from n points at a reference to where they are; see `MotionEstimator`.
struct EstimatorModel {
  static constexpr const char* kName = "EstimatorModel";
  Vector shares;
  Vec3 centroid;
  std::vector<Vec3> centred;
  Matrix gain;
  Mat3 prior_gain;
  double ridge = 0.0;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("shares", shares);
    visit("centroid", centroid);
    visit("centred", centred);
    visit("gain", gain);
    visit("prior_gain", prior_gain);
    visit("ridge", ridge);
  }

  void check() const {
    const size_t count = shares.size();
    expect_count("EstimatorModel.centred", centred.size(), count);
    expect_that(gain.rows == 3 && gain.columns == count, "EstimatorModel.gain",
                "3 rows of a number for each point");
  }
};

// How a robot's palm follows the human's from a reference on; see `PalmMap`.
struct PalmModel {
  static constexpr const char* kName = "PalmModel";
  Pose human_wrist_to_palm, robot_palm_to_wrist;
  bool is_still = false;
  Pose start;
  Mat3 alignment, rotation;
  Vec3 origin, offset, human_anchor, robot_anchor, human_start;
  double further = 0.0;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("human_wrist_to_palm", human_wrist_to_palm);
    visit("robot_palm_to_wrist", robot_palm_to_wrist);
    visit("is_still", is_still);
    visit("start", start);
    visit("alignment", alignment);
    visit("rotation", rotation);
    visit("origin", origin);
    visit("offset", offset);
    visit("human_anchor", human_anchor);
    visit("robot_anchor", robot_anchor);
    visit("human_start", human_start);
    visit("further", further);
  }
  void check() const {}
};

// Points of a hand, and the pairs of them whose p distances are asked for.
struct DistancesModel {
  static constexpr const char* kName = "DistancesModel";
  Indices joints;
  std::vector<Vec3> offsets;
  Indices first, second;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("joints", joints);
    visit("offsets", offsets);
    visit("first", first);
    visit("second", second);
  }

  void check() const {
    expect_count("DistancesModel.offsets", offsets.size(), joints.size());
    expect_count("DistancesModel.second", second.size(), first.size());
    for (const Indices* each : {&first, &second})
      expect_below("DistancesModel: first, second", *each, joints.size());
  }
};

// What `Teleoperation` is for two hands, whatever the reference.
struct TeleoperationModel {
  static constexpr const char* kName = "TeleoperationModel";
  int human_points = 0;
  Vector rest, regularisation;
  EstimatorModel estimator;
  Indices shape_points, from_points, to_points, partners, starts, finger_of;
  Vector human_reach, aim_slopes, aim_offsets, least_aims, largest_aims, extension_weights;
  double pinch_weight = 0.0, pinch_from = 0.0, pinch_over = 0.0, likeness = 0.0;
  Vec3 robot_centre;
  std::vector<Vec3> offsets;
  double ratio = 0.0, gain = 0.0;
  Vector directions;
  std::vector<Vec3> bases;
  Vector ratios, carried, base_margins;
  Indices pinch_pairs, pinch_of_pair;
  Vector pinch_margins;
  double contact_slope = 0.0, contact_from = 0.0, contact_most = 0.0;
  double open_from = 0.0, open_over = 1.0;
  double straight_from = 0.0, straight_over = 1.0, straight_less = 0.0;
  Indices segment_starts, segment_ends, segment_from, segment_to;
  std::vector<Vec3> segment_bases;
  Vector segment_touching;
  double lying_weight = 0.0, lying_from = 0.0, lying_over = 1.0, lying_extension = 0.0;
  double skin_gap = 0.0;
  double tips_from = 0.0, tips_over = 1.0;
  Matrix pinch_rests;
  double rest_from = 0.0, rest_over = 1.0;
  DistancesModel distances;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("human_points", human_points);
    visit("rest", rest);
    visit("regularisation", regularisation);
    visit("estimator", estimator);
    visit("shape_points", shape_points);
    visit("from_points", from_points);
    visit("to_points", to_points);
    visit("partners", partners);
    visit("starts", starts);
    visit("finger_of", finger_of);
    visit("human_reach", human_reach);
    visit("aim_slopes", aim_slopes);
    visit("aim_offsets", aim_offsets);
    visit("least_aims", least_aims);
    visit("largest_aims", largest_aims);
    visit("extension_weights", extension_weights);
    visit("pinch_weight", pinch_weight);
    visit("pinch_from", pinch_from);
    visit("pinch_over", pinch_over);
    visit("likeness", likeness);
    visit("robot_centre", robot_centre);
    visit("offsets", offsets);
    visit("ratio", ratio);
    visit("gain", gain);
    visit("directions", directions);
    visit("bases", bases);
    visit("ratios", ratios);
    visit("carried", carried);
    visit("base_margins", base_margins);
    visit("pinch_pairs", pinch_pairs);
    visit("pinch_of_pair", pinch_of_pair);
    visit("pinch_margins", pinch_margins);
    visit("contact_slope", contact_slope);
    visit("contact_from", contact_from);
    visit("contact_most", contact_most);
    visit("open_from", open_from);
    visit("open_over", open_over);
    visit("straight_from", straight_from);
    visit("straight_over", straight_over);
    visit("straight_less", straight_less);
    visit("segment_starts", segment_starts);
    visit("segment_ends", segment_ends);
    visit("segment_from", segment_from);
    visit("segment_to", segment_to);
    visit("segment_bases", segment_bases);
    visit("segment_touching", segment_touching);
    visit("lying_weight", lying_weight);
    visit("lying_from", lying_from);
    visit("lying_over", lying_over);
    visit("lying_extension", lying_extension);
    visit("skin_gap", skin_gap);
    visit("tips_from", tips_from);
    visit("tips_over", tips_over);
    visit("pinch_rests", pinch_rests);
    visit("rest_from", rest_from);
    visit("rest_over", rest_over);
    visit("distances", distances);
  }

  void check() const {
    estimator.check();
    distances.check();
    expect_that(human_points >= 0, "TeleoperationModel.human_points", "a number of points");
    expect_count("TeleoperationModel.regularisation", regularisation.size(), rest.size());
    check_distances();
    check_points();
    check_pinches();
    check_segments();
  }

 private:
  void check_distances() const {
    const size_t rows = from_points.size(), fingers = human_reach.size();
    expect_that(fingers <= rows, "TeleoperationModel.from_points", "a distance of each finger");
    expect_count("TeleoperationModel.to_points", to_points.size(), rows);
    expect_count("TeleoperationModel.distances", distances.first.size(), rows);
    for (const Vector* each : {&aim_slopes, &aim_offsets, &least_aims, &largest_aims})
      expect_count("TeleoperationModel: aims", each->size(), rows);
    expect_count("TeleoperationModel.extension_weights", extension_weights.size(), fingers);
    expect_count("TeleoperationModel.shape_points", shape_points.size(), estimator.shares.size());
    for (const Indices* each : {&shape_points, &from_points, &to_points, &partners, &starts,
                                &segment_starts, &segment_ends})
      expect_below("TeleoperationModel: points of the human", *each,
                   static_cast<size_t>(human_points));
  }

  void check_points() const {
    const size_t count = partners.size();
    for (const size_t each : {starts.size(), finger_of.size(), offsets.size(), directions.size(),
                              bases.size(), ratios.size(), carried.size()})
      expect_count("TeleoperationModel: points of the robot", each, count);
    // Finger 0 is the thumb, which has all pinches.
    const size_t pinches = from_points.size() - human_reach.size();
    if (pinches > 0) expect_below("TeleoperationModel.finger_of", finger_of, pinches + 1);
  }

  void check_pinches() const {
    const size_t pinches = from_points.size() - human_reach.size();
    expect_that(pinches == 0 || !human_reach.empty(), "TeleoperationModel.human_reach",
                "that of the thumb, which pinches");
    expect_that(pinches == 0 || !segment_starts.empty(), "TeleoperationModel.segment_starts",
                "segments of the fingers that the thumb pinches with");
    expect_that(open_over > 0.0, "TeleoperationModel.open_over", "a length above 0");
    expect_that(rest_over > 0.0, "TeleoperationModel.rest_over", "a length above 0");
    expect_that(straight_over > 0.0, "TeleoperationModel.straight_over", "a share above 0");
    expect_that(pinch_over > straight_less, "TeleoperationModel.pinch_over",
                "more than straight_less");
    expect_that(pinch_rests.rows == pinches && (pinches == 0 || pinch_rests.columns == rest.size()),
                "TeleoperationModel.pinch_rests", "a posture of each pinch");
    expect_count("TeleoperationModel.pinch_margins", pinch_margins.size(), pinch_pairs.size());
    expect_count("TeleoperationModel.pinch_of_pair", pinch_of_pair.size(), pinch_pairs.size());
    expect_below("TeleoperationModel.pinch_pairs", pinch_pairs, base_margins.size());
    expect_below("TeleoperationModel.pinch_of_pair", pinch_of_pair, pinches);
  }

  void check_segments() const {
    for (const size_t each : {segment_ends.size(), segment_from.size(), segment_to.size(),
                              segment_bases.size(), segment_touching.size()})
      expect_count("TeleoperationModel: segments", each, segment_starts.size());
    expect_below("TeleoperationModel.segment_from", segment_from, partners.size(), -1);
    expect_below("TeleoperationModel.segment_to", segment_to, partners.size());
    expect_that(lying_over > 0.0, "TeleoperationModel.lying_over", "a length above 0");
    expect_that(tips_over > 0.0, "TeleoperationModel.tips_over", "a length above 0");
  }
};

// The paper's method from one reference of both hands on; see `HomogeneousMap`.
struct HomogeneousModel {
  static constexpr const char* kName = "HomogeneousModel";
  std::string rigid_from;
  Vector rest;
  EstimatorModel estimator;
  double stretch_min = 0.0, stretch_max = 0.0, deformation_gain = 0.0, scale = 0.0;
  Vec3 pivot, origin;
  Mat3 alignment;
  std::optional<Pose> human_wrist;
  Pose robot_wrist;
  std::vector<Vec3> human_offsets, robot_offsets;
  Matrix share;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("rigid_from", rigid_from);
    visit("rest", rest);
    visit("estimator", estimator);
    visit("stretch_min", stretch_min);
    visit("stretch_max", stretch_max);
    visit("deformation_gain", deformation_gain);
    visit("scale", scale);
    visit("pivot", pivot);
    visit("origin", origin);
    visit("alignment", alignment);
    visit("human_wrist", human_wrist);
    visit("robot_wrist", robot_wrist);
    visit("human_offsets", human_offsets);
    visit("robot_offsets", robot_offsets);
    visit("share", share);
  }

  void check() const {
    estimator.check();
    expect_that(rigid_from == "points" || rigid_from == "wrist" || rigid_from == "none",
                "HomogeneousModel.rigid_from", "points, wrist or none");
    expect_that(rigid_from != "wrist" || human_wrist, "HomogeneousModel.human_wrist", "a pose");
    const size_t count = estimator.shares.size();
    expect_count("HomogeneousModel.human_offsets", human_offsets.size(), count);
    expect_that(share.rows == robot_offsets.size() && share.columns == count,
                "HomogeneousModel.share", "a number for each point of both hands");
  }
};

}  // namespace handmap
