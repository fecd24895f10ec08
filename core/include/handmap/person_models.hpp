// A person's hand as models; see models/person.py, which says what their fields are.
#pragma once

#include "model_reader.hpp"

namespace handmap {

constexpr int kLandmarks = 21;
// Landmarks of the palm, taken as rigid: the wrist and the MCP joints of the four fingers.
constexpr int kPalm[5] = {0, 5, 9, 13, 17};

// The sign of a side in evidence for a right hand.
inline double sign_of(const std::string& side) { return side == "right" ? 1.0 : -1.0; }

// The hand whose samples a guard judges; see `StreamGuard`.
struct GuardModel {
  static constexpr const char* kName = "GuardModel";
  std::string side;
  std::vector<Vec3> landmarks;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("side", side);
    visit("landmarks", landmarks);
  }
  void check() const {
    expect_that(side == "right" || side == "left", "GuardModel.side", "right or left");
    expect_count("GuardModel.landmarks", landmarks.size(), kLandmarks);
  }
};

// What turns landmarks into the reference points of a hand; see `LandmarkReader`.
struct LandmarkReaderModel {
  static constexpr const char* kName = "LandmarkReaderModel";
  Indices used;
  std::vector<Vec3> palm;
  Vector weights;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("used", used);
    visit("palm", palm);
    visit("weights", weights);
  }
  void check() const {
    expect_below("LandmarkReaderModel.used", used, kLandmarks);
    expect_count("LandmarkReaderModel.palm", palm.size(), std::size(kPalm));
    expect_count("LandmarkReaderModel.weights", weights.size(), std::size(kPalm));
  }
};

}  // namespace handmap
