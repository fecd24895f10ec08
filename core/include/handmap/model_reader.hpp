// Models: structs that Python has too, with the same fields, read from their bytes.
//
// A model has a name and lists its fields once, in the order of the class in handmap_core/models:
//
//     struct LimitsModel {
//       static constexpr const char* kName = "LimitsModel";
//       Vector lower, upper;
//       double acceleration;
//       template <class Visitor>
//       void fields(Visitor& visit) {
//         visit("lower", lower);
//         visit("upper", upper);
//         visit("acceleration", acceleration);
//       }
//     };
//
// `decode<LimitsModel>(bytes)` reads what `models.encode` writes; see handmap_core/models/encoding.py for
// the form. It reads bytes of files, so it trusts none: it never reads behind them, and every size is
// compared with the bytes that are left before there is memory for it. The error, a
// std::invalid_argument, names the field:
//
//     HandModel.joints[3].axis: expected an array of floats (3), got one of floats (4)
//
// Whether sizes go with each other, and indices are in range, is for the `check()` of each model.
#pragma once

#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "tree.hpp"

namespace handmap {

// A matrix, row by row.
struct Matrix {
  size_t rows = 0, columns = 0;
  Vector data;
  const double* row(size_t i) const { return data.data() + i * columns; }
};

using Indices = std::vector<int>;
using BoolVector = std::vector<char>;

// Bytes of another model, which are read where they are needed.
struct Bytes {
  std::string data;
};

// -- the forms of fields, as both sides name them

template <class T>
struct Form {  // of another model
  static std::string name() { return T::kName; }
};
#define HANDMAP_FORM(type, text) \
  template <>                    \
  struct Form<type> {            \
    static std::string name() { return text; } \
  };
HANDMAP_FORM(double, "float")
HANDMAP_FORM(int, "int")
HANDMAP_FORM(bool, "bool")
HANDMAP_FORM(std::string, "str")
HANDMAP_FORM(Bytes, "bytes")
HANDMAP_FORM(Vector, "float (n)")
HANDMAP_FORM(Matrix, "float (n, m)")
HANDMAP_FORM(Vec3, "float (3)")
HANDMAP_FORM(std::vector<Vec3>, "float (n, 3)")
HANDMAP_FORM(Mat3, "float (3, 3)")
HANDMAP_FORM(Pose, "float (4, 4)")
HANDMAP_FORM(Indices, "int (n)")
HANDMAP_FORM(BoolVector, "bool (n)")
#undef HANDMAP_FORM
template <class T>
struct Form<std::vector<T>> {
  static std::string name() { return "tuple of " + Form<T>::name(); }
};
template <class T>
struct Form<std::optional<T>> {
  static std::string name() { return Form<T>::name() + " or None"; }
};

// Lists the fields of a model and their forms.
class FieldLister {
 public:
  std::vector<std::pair<std::string, std::string>> found;
  template <class T>
  void operator()(const char* name, T&) {
    found.emplace_back(name, Form<T>::name());
  }
};

template <class Model>
std::vector<std::pair<std::string, std::string>> fields_of() {
  Model model{};
  FieldLister lister;
  model.fields(lister);
  return std::move(lister.found);
}

// -- MessagePack

class ModelReader {
 public:
  explicit ModelReader(std::string_view bytes)
      : at_(reinterpret_cast<const std::uint8_t*>(bytes.data())), end_(at_ + bytes.size()) {}

  template <class Model>
  Model read_whole() {
    path_ = Model::kName;
    Model model{};
    read(model);
    if (at_ != end_) fail("the end of the bytes", "more bytes");
    return model;
  }

  // One field of a model, by the visitor of that.
  template <class T>
  void operator()(const char* name, T& value) {
    if (left_ == 0) fail("the field " + std::string(name), "no more fields");
    --left_;
    const std::string_view key = text(std::string("the field ") + name);
    if (key != name) fail(std::string("the field ") + name, "the field " + printable(key));
    const Below here(*this, std::string(".") + name);
    read(value);
  }

 private:
  // The path of a value inside another one, while that is read.
  class Below {
   public:
    Below(ModelReader& reader, const std::string& step)
        : reader_(reader), before_(reader.path_.size()), left_(reader.left_) {
      reader.path_ += step;
    }
    Below(const Below&) = delete;
    ~Below() {
      reader_.path_.resize(before_);
      reader_.left_ = left_;
    }

   private:
    ModelReader& reader_;
    const size_t before_, left_;
  };

  const std::uint8_t *at_, *end_;
  std::string path_;
  size_t left_ = 0;  // fields of the model that are to be read

  size_t rest() const { return static_cast<size_t>(end_ - at_); }

  [[noreturn]] void fail(const std::string& expected, const std::string& got) const {
    throw std::invalid_argument(path_ + ": expected " + expected + ", got " + got);
  }

  // Text of a file, of which a message has as much as is readable.
  static std::string printable(std::string_view text) {
    std::string found(text.substr(0, 40));
    for (char& each : found)
      if (each < 0x20 || each > 0x7e) each = '?';
    return found;
  }

  // What comes next, for errors.
  std::string next() const {
    if (rest() == 0) return "the end of the bytes";
    const std::uint8_t kind = *at_;
    if (kind <= 0x7f || kind >= 0xe0 || (kind >= 0xcc && kind <= 0xd3)) return "an integer";
    if (kind <= 0x8f || kind == 0xde || kind == 0xdf) return "a model";
    if (kind <= 0x9f || kind == 0xdc || kind == 0xdd) return "a tuple";
    if (kind <= 0xbf || (kind >= 0xd9 && kind <= 0xdb)) return "a text";
    if (kind == 0xc0) return "None";
    if (kind == 0xc2 || kind == 0xc3) return "a flag";
    if (kind == 0xca || kind == 0xcb) return "a number";
    if (kind >= 0xc4 && kind <= 0xc6) return "bytes";
    return "an array";
  }

  // A number of so many bytes, the highest first.
  std::uint64_t big_endian(int count, const std::string& expected) {
    if (rest() < static_cast<size_t>(count)) fail(expected, "the end of the bytes");
    std::uint64_t value = 0;
    for (int i = 0; i < count; ++i) value = value << 8 | *at_++;
    return value;
  }

  // The number of elements behind a head: in its last bits, or in 1, 2 or 4 bytes from a code on.
  // `fixed` 0: the head has no short form; `smallest` is the number of bytes of the first code's size.
  std::optional<size_t> count(std::uint8_t fixed, std::uint8_t mask, std::uint8_t first_code,
                              int smallest, const std::string& expected) {
    if (rest() == 0) return {};
    const std::uint8_t kind = *at_;
    if (fixed != 0 && (kind & static_cast<std::uint8_t>(~mask)) == fixed) {
      ++at_;
      return kind & mask;
    }
    int size = smallest;
    for (std::uint8_t code = first_code; size <= 4; ++code, size *= 2) {
      if (kind != code) continue;
      ++at_;
      return static_cast<size_t>(big_endian(size, expected));
    }
    return {};
  }

  std::string_view block(size_t size, const std::string& expected) {
    if (size > rest()) fail(expected, "the end of the bytes");
    const std::string_view found(reinterpret_cast<const char*>(at_), size);
    at_ += size;
    return found;
  }

  std::string_view text(const std::string& expected) {
    const std::optional<size_t> size = count(0xa0, 0x1f, 0xd9, 1, expected);
    if (!size) fail(expected, next());
    return block(*size, expected);
  }

  size_t elements(const std::string& expected) {
    const std::optional<size_t> size = count(0x90, 0x0f, 0xdc, 2, expected);
    if (!size) fail(expected, next());
    // Each takes a byte at least.
    if (*size > rest()) fail(expected, "the end of the bytes");
    return *size;
  }

  std::int64_t integer(const std::string& expected) {
    if (rest() == 0) fail(expected, next());
    const std::uint8_t kind = *at_;
    if (kind <= 0x7f || kind >= 0xe0) {
      ++at_;
      return static_cast<std::int8_t>(kind);
    }
    if (kind < 0xcc || kind > 0xd3) fail(expected, next());
    ++at_;
    const bool is_signed = kind >= 0xd0;
    const int size = 1 << (kind - (is_signed ? 0xd0 : 0xcc));
    const std::uint64_t value = big_endian(size, expected);
    if (!is_signed) {
      if (value > static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max()))
        fail(expected, "a larger one");
      return static_cast<std::int64_t>(value);
    }
    const int unused = 64 - 8 * size;
    return static_cast<std::int64_t>(value << unused) >> unused;
  }

  // -- values

  // A model; anything else has an overload below.
  template <class Model>
  void read(Model& model) {
    const std::string expected = std::string("a model ") + Model::kName;
    const std::optional<size_t> size = count(0x80, 0x0f, 0xde, 2, expected);
    if (!size) fail(expected, next());
    left_ = *size;
    model.fields(*this);
    if (left_ > 0) fail("no more fields", "the field " + printable(text("a field")));
  }

  template <class T>
  void read(std::optional<T>& value) {
    if (rest() > 0 && *at_ == 0xc0) {
      ++at_;
      value.reset();
      return;
    }
    read(value.emplace());
  }

  template <class T>
  void read(std::vector<T>& values) {
    const size_t size = elements("a tuple");
    values.clear();
    for (size_t i = 0; i < size; ++i) {
      const Below here(*this, "[" + std::to_string(i) + "]");
      values.emplace_back();
      read(values.back());
    }
  }

  void read(bool& value) {
    if (rest() == 0 || (*at_ != 0xc2 && *at_ != 0xc3)) fail("a flag", next());
    value = *at_++ == 0xc3;
  }

  void read(int& value) {
    const std::int64_t given = integer("an integer");
    if (given < std::numeric_limits<int>::min() || given > std::numeric_limits<int>::max())
      fail("an integer of 32 bits", std::to_string(given));
    value = static_cast<int>(given);
  }

  void read(double& value) {
    if (rest() == 0) fail("a number", next());
    if (*at_ == 0xcb) {
      ++at_;
      const std::uint64_t bits = big_endian(8, "a number");
      std::memcpy(&value, &bits, sizeof value);
      return;
    }
    value = static_cast<double>(integer("a number"));
  }

  void read(std::string& value) { value = text("a text"); }

  void read(Bytes& value) {
    const std::optional<size_t> size = count(0, 0, 0xc4, 1, "bytes");
    if (!size) fail("bytes", next());
    value.data = block(*size, "bytes");
  }

  // -- arrays

  struct Numbers {
    std::string_view kind;  // as numpy writes it
    std::vector<size_t> shape;
    std::string_view data;
  };

  // Largest axis of an array without elements.
  static constexpr size_t kLargestEmpty = 1 << 16;

  static std::string form_of(const Numbers& numbers) {
    std::string form = numbers.kind == "<f8" ? "floats" : numbers.kind == "|b1" ? "flags" : "integers";
    form += " (";
    for (size_t i = 0; i < numbers.shape.size(); ++i)
      form += (i ? ", " : "") + std::to_string(numbers.shape[i]);
    return form + ")";
  }

  // An array, whose numbers stay where they are.
  Numbers numbers(const std::string& expected) {
    // An extension of 1, 2, 4, 8 or 16 bytes has them in its code.
    std::optional<size_t> size;
    if (rest() > 0 && *at_ >= 0xd4 && *at_ <= 0xd8)
      size = size_t{1} << (*at_++ - 0xd4);
    else
      size = count(0, 0, 0xc7, 1, expected);
    if (!size) fail(expected, next());
    constexpr std::uint64_t kArray = 1;
    if (big_endian(1, expected) != kArray) fail(expected, "another extension");
    if (*size > rest()) fail(expected, "the end of the bytes");
    ModelReader inside(std::string_view(reinterpret_cast<const char*>(at_), *size));
    inside.path_ = path_;
    at_ += *size;
    Numbers found;
    if (inside.elements(expected) != 3) fail(expected, "an array of other parts");
    found.kind = inside.text(expected);
    const size_t axes = inside.elements(expected);
    size_t total = 1;
    for (size_t i = 0; i < axes; ++i) {
      const std::int64_t length = inside.integer(expected);
      if (length < 0) fail(expected, "a negative size");
      // No axis, nor their product, has more elements than there are bytes. Behind an axis without
      // elements, others have none either, whatever they say.
      const size_t most = total > 0 ? *size / total : kLargestEmpty;
      const bool is_right = static_cast<std::uint64_t>(length) <= most;
      if (!is_right) fail(expected, "an array of another size than it says");
      found.shape.push_back(static_cast<size_t>(length));
      total *= found.shape.back();
    }
    const std::optional<size_t> bytes = inside.count(0, 0, 0xc4, 1, expected);
    if (!bytes) fail(expected, "an array without numbers");
    found.data = inside.block(*bytes, expected);
    if (inside.rest() > 0) fail(expected, "an array with more behind it");
    const size_t width = found.kind == "<f8" || found.kind == "<i8" ? 8
                         : found.kind == "<i4"                      ? 4
                         : found.kind == "|b1"                      ? 1
                                                                    : 0;
    if (width == 0) fail(expected, "numbers of the type " + printable(found.kind));
    if (found.data.size() != total * width)
      fail(expected, "an array of another size than it says");
    return found;
  }

  // Floats with a last part of their shape; the first axis is free if `is_list`.
  std::string_view floats(const char* form, bool is_list, std::initializer_list<size_t> last) {
    const std::string expected = std::string("an array of floats ") + form;
    const Numbers found = numbers(expected);
    bool is_right = found.kind == "<f8" && found.shape.size() == last.size() + is_list;
    size_t axis = is_list;
    for (const size_t each : last) is_right = is_right && found.shape[axis++] == each;
    if (!is_right) fail(expected, "one of " + form_of(found));
    return found.data;
  }

  static void copy(std::string_view from, double* to) {
    if (!from.empty()) std::memcpy(to, from.data(), from.size());
  }
  static std::vector<double> vector_of(std::string_view from) {
    Vector found(from.size() / sizeof(double));
    copy(from, found.data());
    return found;
  }

  void read(Vector& value) { value = vector_of(floats("(n)", true, {})); }

  void read(Matrix& value) {
    const std::string expected = "an array of floats (n, m)";
    const Numbers found = numbers(expected);
    if (found.kind != "<f8" || found.shape.size() != 2) fail(expected, "one of " + form_of(found));
    value = {found.shape[0], found.shape[1], vector_of(found.data)};
  }

  void read(Vec3& value) {
    double at[3];
    copy(floats("(3)", false, {3}), at);
    value = {at[0], at[1], at[2]};
  }

  void read(std::vector<Vec3>& value) {
    const Vector at = vector_of(floats("(n, 3)", true, {3}));
    value.clear();
    for (size_t k = 0; k < at.size(); k += 3) value.push_back({at[k], at[k + 1], at[k + 2]});
  }

  void read(Mat3& value) { copy(floats("(3, 3)", false, {3, 3}), value.m); }

  void read(Pose& value) {
    double at[16];
    copy(floats("(4, 4)", false, {4, 4}), at);
    value = pose_of(at);
  }

  void read(Indices& value) {
    const std::string expected = "an array of integers (n)";
    const Numbers found = numbers(expected);
    if ((found.kind != "<i8" && found.kind != "<i4") || found.shape.size() != 1)
      fail(expected, "one of " + form_of(found));
    value.clear();
    const size_t width = found.kind == "<i8" ? 8 : 4;
    for (size_t k = 0; k < found.data.size(); k += width) {
      std::int64_t wide = 0;
      std::int32_t narrow = 0;
      std::memcpy(width == 8 ? static_cast<void*>(&wide) : &narrow, found.data.data() + k, width);
      const std::int64_t given = width == 8 ? wide : narrow;
      if (given < std::numeric_limits<int>::min() || given > std::numeric_limits<int>::max())
        fail("integers of 32 bits", std::to_string(given));
      value.push_back(static_cast<int>(given));
    }
  }

  void read(BoolVector& value) {
    const std::string expected = "an array of flags (n)";
    const Numbers found = numbers(expected);
    if (found.kind != "|b1" || found.shape.size() != 1) fail(expected, "one of " + form_of(found));
    value.clear();
    for (const char each : found.data) value.push_back(each != 0);
  }
};

// -- what models check

inline void expect_that(bool is_right, const std::string& what, const std::string& expected) {
  if (!is_right) throw std::invalid_argument(what + ": expected " + expected);
}

inline void expect_count(const std::string& what, size_t count, size_t expected) {
  if (count != expected)
    throw std::invalid_argument(what + ": expected " + std::to_string(expected) + " of them, got " +
                                std::to_string(count));
}

// Indices below a count, from -1 on where that stands for something.
inline void expect_below(const std::string& what, const Indices& indices, size_t count,
                         int least = 0) {
  for (const int i : indices)
    if (i < least || (i >= 0 && static_cast<size_t>(i) >= count))
      throw std::invalid_argument(what + ": expected indices below " + std::to_string(count) +
                                  ", got " + std::to_string(i));
}

// Read a model from its bytes, and check it.
template <class Model>
Model decode(std::string_view bytes) {
  Model model = ModelReader(bytes).read_whole<Model>();
  model.check();
  return model;
}

}  // namespace handmap
