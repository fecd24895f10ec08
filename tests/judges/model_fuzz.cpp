// Damaged bytes of models, as those of a file may be: each is refused, or makes a part of the core that
// computes without a read or write outside of its arrays. Built with the sanitizers by model_fuzz.py.
//
//     model_fuzz FOLDER SEED SECONDS [ROUNDS]
//
// FOLDER has the bytes of valid models, each in a file that is named after its model up to the first
// "-". Prints the number of bytes that were tried, and how many of them were accepted.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <random>

#include "handmap/detours.hpp"
#include "handmap/hand_model.hpp"
#include "handmap/ik_models.hpp"
#include "handmap/pair_models.hpp"
#include "handmap/person_models.hpp"
#include "handmap/robot_model.hpp"
#include "handmap/targets.hpp"

using namespace handmap;

namespace {

using Bytes = std::string;

// -- what is done with a model that was accepted

void use(HandModel model) {
  const Tree tree = tree_of(std::move(model));
  Placed placed(tree);
  placed.place(tree.rest.data());
  for (const Attached& point : tree.points) placed.point(point);
  for (const Part& part : tree.parts) placed.wrist(part);
  const Vector joints(tree.q_indices.size(), 0.1), step(static_cast<size_t>(tree.size), 0.1);
  placed.place(tree.configuration(joints.data()).data());
  placed.displace(tree.rest.data(), step.data());
}

void use(PairsModel model) {
  const PairBounds bounds = bounds_of(std::move(model));
  for (const Pair& pair : bounds.pairs) {
    const Body &a = bounds.bodies[pair.first], &b = bounds.bodies[pair.second];
    Warm warm{};
    measure(a.shape, a.placement, b.shape, b.placement, warm);
  }
}

void compute_targets(const TargetMap& map) {
  std::vector<Vec3> points(map.human_points);
  for (size_t k = 0; k < points.size(); ++k) points[k] = {0.01 * static_cast<double>(k), 0.05, 0.0};
  const Pose wrist;
  Targets targets;
  map.targets(points, &wrist, targets);
  map.residual(targets);
}

// Models are as large as their numbers say, and a person has 21 landmarks.
constexpr int kMostPoints = 1000;

void use(TeleoperationModel model) {
  if (model.human_points <= kMostPoints) compute_targets(TeleoperationMap(std::move(model), {}));
}
void use(const HomogeneousModel& model) { compute_targets(HomogeneousMap(model)); }
void use(const DistancesModel& model) { task_of(model); }

template <class Model>
void use(const Model&) {}

// -- one try

template <class Model>
bool accepts(const Bytes& bytes) {
  try {
    use(decode<Model>(bytes));
    return true;
  } catch (const std::invalid_argument&) {
    return false;
  }
}

using Reader = bool (*)(const Bytes&);

template <class... Models>
std::map<std::string, Reader> readers_of() {
  return {{Models::kName, &accepts<Models>}...};
}

const std::map<std::string, Reader> kReaders =
    readers_of<HandModel, BoxLimits, PairsModel, CollisionModel, IkModel, DistancesModel, PalmModel,
               TeleoperationModel, HomogeneousModel, GuardModel, LandmarkReaderModel, RobotModel>();

// -- damage

class Damage {
 public:
  explicit Damage(unsigned seed) : engine_(seed) {}

  size_t below(size_t count) { return std::uniform_int_distribution<size_t>(0, count - 1)(engine_); }

  Bytes done(Bytes bytes) {
    for (size_t more = 1 + below(4); more > 0 && !bytes.empty(); --more) once(bytes);
    return bytes;
  }

 private:
  void once(Bytes& bytes) {
    const size_t at = below(bytes.size());
    switch (below(8)) {
      case 0:
        bytes[at] = static_cast<char>(below(256));
        break;
      case 1:
        bytes[at] = static_cast<char>(bytes[at] ^ (1 << below(8)));
        break;
      case 2:
        bytes.resize(at);
        break;
      case 3:
        bytes.insert(at, bytes.substr(below(bytes.size()), below(40)));
        break;
      case 4:
        bytes.erase(at, 1 + below(16));
        break;
      case 5: {
        // The head of a longer array, map, text or extension.
        constexpr unsigned char kHeads[] = {0xc1, 0xc6, 0xc9, 0xca, 0xcb, 0xdb, 0xdd, 0xdf, 0xff, 0x80};
        bytes[at] = static_cast<char>(kHeads[below(std::size(kHeads))]);
        break;
      }
      case 6: {
        constexpr double kNumbers[] = {0.0, -1.0, 1e308, -1e-308, HUGE_VAL, NAN, 1e9};
        overwrite(bytes, at, kNumbers[below(std::size(kNumbers))]);
        break;
      }
      default: {
        constexpr std::int64_t kIntegers[] = {-1, 0, 1, 7, 1000, -1000, 1LL << 31, -(1LL << 31) - 1};
        overwrite(bytes, at, kIntegers[below(std::size(kIntegers))]);
      }
    }
  }
  template <class Number>
  static void overwrite(Bytes& bytes, size_t at, Number number) {
    if (bytes.size() - at >= sizeof number) std::memcpy(&bytes[at], &number, sizeof number);
  }

  std::mt19937_64 engine_;
};

struct Valid {
  Reader reader;
  Bytes bytes;
};

std::vector<Valid> valid_in(const std::filesystem::path& folder) {
  std::vector<std::filesystem::path> files;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  std::vector<Valid> found;
  for (const std::filesystem::path& file : files) {
    std::ifstream stream(file, std::ios::binary);
    Bytes bytes{std::istreambuf_iterator<char>(stream), {}};
    const std::string name = file.filename().string();
    const auto reader = kReaders.find(name.substr(0, name.find('-')));
    if (reader == kReaders.end() || !reader->second(bytes)) {
      std::printf("not a valid model: %s\n", name.c_str());
      std::exit(1);
    }
    found.push_back({reader->second, std::move(bytes)});
  }
  return found;
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 4) return 2;
  const std::vector<Valid> valid = valid_in(arguments[1]);
  Damage damage(static_cast<unsigned>(std::atoi(arguments[2])));
  const double seconds = std::atof(arguments[3]);
  const long most = count > 4 ? std::atol(arguments[4]) : -1;
  using Clock = std::chrono::steady_clock;
  const auto end = Clock::now() + std::chrono::duration<double>(seconds);
  long tried = 0, accepted = 0;
  while (tried != most && (most > 0 || Clock::now() < end)) {
    const Valid& one = valid[damage.below(valid.size())];
    accepted += one.reader(damage.done(one.bytes));
    ++tried;
  }
  std::printf("%ld tried, %ld accepted\n", tried, accepted);
}
