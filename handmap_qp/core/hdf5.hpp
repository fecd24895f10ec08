// Arrays of HDF5 files as h5py writes them by default: contiguous numbers in groups of the first
// kind, which libhdf5 opens one by one in 14 us each. See trackers/formats/hdf5.py.
//
// What is anything else (other versions, filters, damage) is `Unread`, and left to libhdf5. Names of
// parts are those of the HDF5 file format specification, version 3.0.
#pragma once

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <map>
#include <string>
#include <vector>

#include "vector.hpp"

namespace handmap {

struct Unread {};

inline void expect_read(bool is_right) {
  if (!is_right) throw Unread{};
}

// Bytes of a file, each access within them.
class Bytes {
 public:
  explicit Bytes(size_t size) : data_(size) {}
  char* data() { return data_.data(); }
  size_t size() const { return data_.size(); }
  template <class T>
  T at(size_t place) const {
    expect_read(place <= size() && sizeof(T) <= size() - place);
    T value;
    std::memcpy(&value, data_.data() + place, sizeof(T));
    return value;
  }
  Bytes part(size_t from, size_t count) const {
    expect_read(from <= size() && count <= size() - from);
    Bytes found(count);
    std::memcpy(found.data(), data_.data() + from, count);
    return found;
  }
  bool has(size_t place, const char* signature) const {
    const size_t length = std::strlen(signature);
    return place <= size() && length <= size() - place &&
           std::memcmp(data_.data() + place, signature, length) == 0;
  }
  std::string text(size_t place) const {
    expect_read(place < size());
    const void* end = std::memchr(data_.data() + place, 0, size() - place);
    expect_read(end != nullptr);
    return data_.data() + place;
  }

 private:
  std::vector<char> data_;
};

class Hdf5File {
 public:
  using Group = std::map<std::string, uint64_t>;  // addresses of object headers by name

  explicit Hdf5File(const char* path) : file_(open(path, O_RDONLY | O_CLOEXEC)) {
    struct stat found;
    expect_read(file_ >= 0);
    if (fstat(file_, &found) == 0 && S_ISREG(found.st_mode)) size_ = found.st_size;
  }
  ~Hdf5File() {
    if (file_ >= 0) close(file_);
  }
  Hdf5File(const Hdf5File&) = delete;
  Hdf5File& operator=(const Hdf5File&) = delete;

  Group root() const {
    const Bytes superblock = read(0, 96);
    // Version 0, addresses and lengths of 8 bytes, no user block, no driver.
    expect_read(superblock.has(0, "\x89HDF\r\n\x1a\n") && superblock.at<uint8_t>(8) == 0 &&
                superblock.at<uint16_t>(13) == 0x0808 && superblock.at<uint64_t>(24) == 0 &&
                superblock.at<uint64_t>(40) <= size_ &&
                superblock.at<uint64_t>(48) == kUndefined);
    return group(superblock.at<uint64_t>(64));
  }

  Group group(uint64_t header) const {
    for (const Message& message : messages(header)) {
      if (message.type != 0x11) continue;
      const uint64_t heap = message.body.at<uint64_t>(8);
      const Bytes start = read(heap, 32);
      expect_read(start.has(0, "HEAP") && start.at<uint8_t>(4) == 0);
      const Bytes names = read(start.at<uint64_t>(24), start.at<uint64_t>(8));
      Group found;
      add_entries(message.body.at<uint64_t>(0), names, kDeepest, found);
      return found;
    }
    throw Unread{};
  }

  // The numbers of a dataset whose size is `shape`.
  void numbers(uint64_t header, const std::vector<uint64_t>& shape, Vector& found) const {
    size_t count = 1, width = 0;
    for (const uint64_t size : shape) count *= size;
    uint64_t address = kUndefined, length = 0;
    bool has_shape = false;
    for (const Message& message : messages(header)) {
      const Bytes& body = message.body;
      switch (message.type) {
        case 0x01: has_shape = is_of_shape(body, shape); break;
        case 0x03: width = float_width(body); break;
        case 0x08:
          // Contiguous.
          expect_read((body.at<uint8_t>(0) == 3 || body.at<uint8_t>(0) == 4) &&
                      body.at<uint8_t>(1) == 1);
          address = body.at<uint64_t>(2);
          length = body.at<uint64_t>(10);
          break;
        case 0x07: case 0x0b: throw Unread{};  // external files, filters
        default: break;
      }
    }
    expect_read(has_shape && width != 0 && length == count * width);
    Bytes raw = read(address, length);
    found.resize(count);
    if (width == sizeof(double)) {
      std::memcpy(found.data(), raw.data(), length);
    } else {
      for (size_t i = 0; i < count; ++i) found[i] = raw.at<float>(i * width);
    }
  }

 private:
  static constexpr uint64_t kUndefined = ~uint64_t{0};
  static constexpr int kDeepest = 6;       // levels of a group's tree
  static constexpr uint64_t kUsual = 512;    // object header of an array [bytes]
  static constexpr uint64_t kWindow = 4096;  // read at once of what is small [bytes]
  static constexpr size_t kMost = 1 << 16;     // names of a group
  static constexpr size_t kLargest = 1 << 20;  // block of an object header [bytes]

  struct Message {
    int type;
    Bytes body;
  };

  Bytes read(uint64_t from, uint64_t count) const {
    expect_read(from <= size_ && count <= size_ - from);
    if (count > kUsual) return read_whole(from, count);
    // Headers and nodes lie together.
    if (from < window_from_ || from + count > window_from_ + window_.size()) {
      window_ = read_whole(from, std::min(kWindow, size_ - from));
      window_from_ = from;
    }
    return window_.part(from - window_from_, count);
  }

  Bytes read_whole(uint64_t from, uint64_t count) const {
    Bytes found(count);
    for (size_t done = 0; done < count;) {
      const ssize_t more = pread(file_, found.data() + done, count - done, from + done);
      expect_read(more > 0);
      done += more;
    }
    return found;
  }

  // Messages of an object header of version 1 with its continuations.
  std::vector<Message> messages(uint64_t header) const {
    expect_read(header <= size_);
    const Bytes start = read(header, std::min<uint64_t>(kUsual, size_ - header));
    expect_read(start.at<uint8_t>(0) == 1);
    const size_t first = start.at<uint32_t>(8);
    std::vector<std::pair<uint64_t, uint64_t>> blocks{{header + 16, first}};
    std::vector<Message> found;
    size_t left = start.at<uint16_t>(2);
    for (size_t k = 0; k < blocks.size() && left > 0; ++k) {
      expect_read(blocks[k].second <= kLargest);
      const bool is_read = k == 0 && 16 + first <= start.size();
      Bytes block = is_read ? start.part(16, first) : read(blocks[k].first, blocks[k].second);
      for (size_t at = 0; at + 8 <= block.size() && left > 0; --left) {
        const size_t size = block.at<uint16_t>(at + 2);
        expect_read(size <= block.size() - at - 8);
        const int type = block.at<uint16_t>(at);
        expect_read(!(block.at<uint8_t>(at + 4) & 2));  // a shared message is elsewhere
        Bytes body = block.part(at + 8, size);
        if (type == 0x10) blocks.push_back({body.at<uint64_t>(0), body.at<uint64_t>(8)});
        else found.push_back({type, std::move(body)});
        at += 8 + size;
      }
    }
    expect_read(left == 0);
    return found;
  }

  void add_entries(uint64_t node, const Bytes& names, int deepest, Group& found) const {
    const Bytes start = read(node, 24);
    const size_t count = start.at<uint16_t>(6);
    expect_read(start.has(0, "TREE") && start.at<uint8_t>(4) == 0 && deepest > 0);
    const bool is_leaf = start.at<uint8_t>(5) == 0;
    // Keys and addresses take turns.
    const Bytes children = read(node + 24, 16 * count);
    for (size_t k = 0; k < count; ++k) {
      const uint64_t child = children.at<uint64_t>(16 * k + 8);
      if (is_leaf) add_symbols(child, names, found);
      else add_entries(child, names, deepest - 1, found);
      expect_read(found.size() < kMost);
    }
  }

  void add_symbols(uint64_t node, const Bytes& names, Group& found) const {
    const Bytes start = read(node, 8);
    expect_read(start.has(0, "SNOD") && start.at<uint8_t>(4) == 1);
    const size_t count = start.at<uint16_t>(6);
    const Bytes entries = read(node + 8, 40 * count);
    for (size_t k = 0; k < count; ++k)
      // A symbolic link has no address.
      if (entries.at<uint32_t>(40 * k + 16) != 2)
        found[names.text(entries.at<uint64_t>(40 * k))] = entries.at<uint64_t>(40 * k + 8);
  }

  static bool is_of_shape(const Bytes& dataspace, const std::vector<uint64_t>& shape) {
    const int version = dataspace.at<uint8_t>(0);
    expect_read(version == 1 || (version == 2 && dataspace.at<uint8_t>(3) == 1));
    if (dataspace.at<uint8_t>(1) != shape.size()) return false;
    for (size_t i = 0; i < shape.size(); ++i)
      if (dataspace.at<uint64_t>((version == 1 ? 8 : 4) + 8 * i) != shape[i]) return false;
    return true;
  }

  // Bytes of a number as this machine has it.
  static size_t float_width(const Bytes& datatype) {
    // Class and version, bits, size; bit offset, precision, places of exponent and mantissa, bias.
    static const unsigned char kDouble[] = {0x20, 0x3f, 0, 8, 0, 0, 0, 0, 0, 64, 0,
                                            52,   11,   0, 52, 0xff, 3, 0, 0};
    static const unsigned char kFloat[] = {0x20, 0x1f, 0, 4, 0, 0, 0, 0, 0, 32, 0,
                                           23,   8,    0, 23, 0x7f, 0, 0, 0};
    expect_read(datatype.size() >= 20 && (datatype.at<uint8_t>(0) & 0x0f) == 1);
    Bytes rest = datatype;
    if (!std::memcmp(rest.data() + 1, kDouble, sizeof kDouble)) return sizeof(double);
    expect_read(!std::memcmp(rest.data() + 1, kFloat, sizeof kFloat));
    return sizeof(float);
  }

  int file_;
  uint64_t size_ = 0;
  mutable uint64_t window_from_ = 0;
  mutable Bytes window_{0};
};

}  // namespace handmap
