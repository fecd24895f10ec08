// A hand follows the samples of a file, and prints its commands.
//
//     handmap hands save allegro_right && handmap convert demo demo.csv
//     01_loop allegro_right.hand demo.csv > commands.csv
#include <cstdio>

#include "samples.hpp"

namespace {

void run(const std::string& hand_file, const std::string& samples_file) {
  const Hand hand = load_hand(hand_file);
  std::printf("time,rule,held");
  for (size_t j = 0; j < handmap_joint_count(hand.get()); ++j)
    std::printf(",%s", handmap_joint_name(hand.get(), j));
  std::printf("\n");
  for (const Sample& sample : read_samples(samples_file, handmap_side(hand.get()))) {
    const handmap_sample given = to_library(sample);
    handmap_command command;
    check(handmap_follow(hand.get(), &given, &command));
    // Send command.q to your robot here.
    std::printf("%.17g,%s,%d", command.time, command.rule, command.is_held);
    for (size_t j = 0; j < command.joints; ++j) std::printf(",%.17g", command.q[j]);
    std::printf("\n");
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 3) {
    std::fprintf(stderr, "usage: 01_loop FILE.hand SAMPLES.csv\n");
    return 2;
  }
  try {
    run(arguments[1], arguments[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "01_loop: %s\n", error.what());
    return 1;
  }
}
