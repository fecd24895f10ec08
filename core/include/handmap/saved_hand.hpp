// The file of a saved hand (`handmap hands save`), as C++ reads it: see handmap_core/run/saved_file.py.
#pragma once

#include "follower_model.hpp"

namespace handmap {

// The version of this library, without a build number; its build gives it.
#ifndef HANDMAP_VERSION
#define HANDMAP_VERSION "unknown"
#endif

// Thrown where bytes are no saved hand, a damaged one, one of another version, or one without a part for
// C++; says what to do.
struct HandError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// What a file has. `core` is a `FollowerModel`, in MessagePack again; empty where only Python follows.
struct SavedFile {
  static constexpr const char* kName = "SavedFile";
  static constexpr const char* kKind = "handmap hand";
  std::string kind, version;
  int form = 0;
  double checksum = 0.0;  // CRC-32 of `body` and `core`, behind each other; exact in a double
  Bytes body, core;

  template <class Visitor>
  void fields(Visitor& visit) {
    visit("kind", kind);
    visit("version", version);
    visit("checksum", checksum);
    visit("body", body);
    visit("form", form);
    visit("core", core);
  }
};

// CRC-32 as zlib has it, of bytes behind those whose checksum is given.
inline std::uint32_t crc32(std::string_view bytes, std::uint32_t before = 0) {
  std::uint32_t rest = ~before;
  for (const char each : bytes) {
    rest ^= static_cast<std::uint8_t>(each);
    for (int bit = 0; bit < 8; ++bit) rest = (rest >> 1) ^ (0xedb88320u & (0u - (rest & 1u)));
  }
  return ~rest;
}

// Read the hand of a file.
inline FollowerModel read_saved_hand(std::string_view bytes) {
  SavedFile file;
  try {
    file = ModelReader(bytes).read_whole<SavedFile>();
  } catch (const std::invalid_argument& error) {
    throw HandError(std::string("expected a saved hand (handmap hands save), got another, older or "
                                "damaged file (") +
                    error.what() + ")");
  }
  if (file.kind != SavedFile::kKind) throw HandError("expected a saved hand (handmap hands save)");
  if (file.version != HANDMAP_VERSION)
    throw HandError("it is of version " + file.version + ", expected " HANDMAP_VERSION
                    "; save it again, by handmap-qp " HANDMAP_VERSION);
  if (crc32(file.core.data, crc32(file.body.data)) != file.checksum)
    throw HandError("it is damaged; copy it again");
  if (file.core.data.empty())
    throw HandError("only Python follows with it: it has two hands, or the method of the paper");
  try {
    return decode<FollowerModel>(file.core.data);
  } catch (const std::invalid_argument& error) {
    throw HandError(std::string("it does not fit this version (") + error.what() + ")");
  }
}

}  // namespace handmap
