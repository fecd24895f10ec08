#include "hand_node.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
#include <iterator>
#include <stdexcept>

namespace handmap_ros2 {

namespace {

constexpr size_t kLandmarks = 21;
// Without a sample for this many usual intervals, the robot brakes and holds.
constexpr double kSilentIntervals = 3.0;
// A late command gets no more time than this many usual intervals, so that the robot does not leap.
constexpr double kLongestIntervals = 3.0;
constexpr double kShortestDt = 1e-6;  // [s]
constexpr double kReportPeriod = 1.0;  // of silence [s]

// Quaternion of a pose's rotation, by its largest component (Shepperd's method).
geometry_msgs::msg::Quaternion quaternion_of(const double* pose) {
  const auto at = [pose](int row, int column) { return pose[4 * row + column]; };
  const double trace = at(0, 0) + at(1, 1) + at(2, 2);
  // Four times the squares of x, y, z and w.
  const std::array<double, 4> squares = {1.0 + 2.0 * at(0, 0) - trace, 1.0 + 2.0 * at(1, 1) - trace,
                                         1.0 + 2.0 * at(2, 2) - trace, 1.0 + trace};
  const int largest = static_cast<int>(
      std::max_element(squares.begin(), squares.end()) - squares.begin());
  std::array<double, 4> q{};
  q[largest] = 0.5 * std::sqrt(squares[largest]);
  const double scale = 0.25 / q[largest];
  if (largest == 3) {
    q[0] = scale * (at(2, 1) - at(1, 2));
    q[1] = scale * (at(0, 2) - at(2, 0));
    q[2] = scale * (at(1, 0) - at(0, 1));
  } else {
    const int i = largest, j = (i + 1) % 3, k = (i + 2) % 3;
    q[j] = scale * (at(j, i) + at(i, j));
    q[k] = scale * (at(k, i) + at(i, k));
    q[3] = scale * (at(k, j) - at(j, k));
  }
  geometry_msgs::msg::Quaternion quaternion;
  quaternion.x = q[0];
  quaternion.y = q[1];
  quaternion.z = q[2];
  quaternion.w = q[3];
  return quaternion;
}

}  // namespace

HandNode::HandNode() : Node("handmap") {
  session_ = declare_parameter<std::string>("session", "ros");
  const auto robot = declare_parameter<std::string>("robot", "");
  const auto controller = declare_parameter<std::string>("controller", "hand_controller");
  load(robot);

  joints_ = create_publisher<sensor_msgs::msg::JointState>("joint_commands", 10);
  wrist_ = create_publisher<geometry_msgs::msg::PoseStamped>("wrist_command", 10);
  trajectory_ = create_publisher<trajectory_msgs::msg::JointTrajectory>(
      "/" + controller + "/joint_trajectory", 10);
  forward_ =
      create_publisher<std_msgs::msg::Float64MultiArray>("/" + controller + "/commands", 10);
  diagnostics_ = create_publisher<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics", 10);
  serve("stop", &HandNode::stop);
  serve("clear", &HandNode::clear);
  serve("engage", &HandNode::engage);
  serve("disengage", &HandNode::disengage);
  // Best effort takes samples of trackers of both kinds, and only the newest one counts.
  landmarks_ = create_subscription<geometry_msgs::msg::PoseArray>(
      "human/landmarks", rclcpp::SensorDataQoS().keep_last(1),
      [this](geometry_msgs::msg::PoseArray::ConstSharedPtr message) { on_landmarks(*message); });
  const std::chrono::duration<double> period(usual_dt_);
  timer_ = create_wall_timer(std::chrono::duration_cast<std::chrono::nanoseconds>(period),
                             [this] { on_timer(); });
}

void HandNode::load(const std::string& file) {
  if (file.empty())
    throw std::runtime_error("parameter robot: expected the file of a saved hand (handmap hands save)");
  std::ifstream stream(file, std::ios::binary);
  if (!stream) throw std::runtime_error("parameter robot: " + file + " cannot be read");
  const std::string bytes(std::istreambuf_iterator<char>(stream), {});
  handmap_follower* hand = nullptr;
  if (handmap_load(bytes.data(), bytes.size(), nullptr, &hand) != HANDMAP_OK)
    throw std::runtime_error("parameter robot: " + file + ": " + handmap_last_error());
  hand_.reset(hand);
  usual_dt_ = handmap_usual_dt(hand);
  for (size_t j = 0; j < handmap_joint_count(hand); ++j)
    joint_names_.emplace_back(handmap_joint_name(hand, j));
}

// -- samples and silence

void HandNode::on_landmarks(const geometry_msgs::msg::PoseArray& message) {
  const size_t count = message.poses.size();
  if (count != 0 && count != kLandmarks) {
    warn("human/landmarks: expected 21 poses, or none while no hand is seen, got " +
         std::to_string(count));
    return;
  }
  std::array<double, 3 * kLandmarks> points{};
  for (size_t i = 0; i < count; ++i) {
    const auto& at = message.poses[i].position;
    points[3 * i] = at.x;
    points[3 * i + 1] = at.y;
    points[3 * i + 2] = at.z;
  }
  const double now = steady_.now().seconds();
  const double dt = time_since_command(now);
  handmap_sample sample = handmap_new_sample(rclcpp::Time(message.header.stamp).seconds(), points.data());
  sample.valid = count == kLandmarks;
  sample.arrival = now;
  sample.dt = dt;
  handmap_command command;
  if (handmap_follow(hand_.get(), &sample, &command) != HANDMAP_OK) {
    // The timer holds the robot if no better sample comes.
    warn(handmap_last_error());
    return;
  }
  last_sample_ = now;
  publish(command, now, dt);
}

void HandNode::on_timer() {
  const double now = steady_.now().seconds();
  // Before the first sample there is nothing to hold: the robot stays where it is.
  const bool is_silent = !has_commands_ || now - last_sample_ > kSilentIntervals * usual_dt_;
  if (!is_silent) return;
  if (now - last_report_ > kReportPeriod) {
    last_report_ = now;
    report(diagnostic_msgs::msg::DiagnosticStatus::ERROR, "no landmarks come", "");
  }
  if (!has_commands_) return;
  const double dt = time_since_command(now);
  handmap_command command;
  if (handmap_hold(hand_.get(), dt, &command) != HANDMAP_OK)
    warn(handmap_last_error());
  else
    publish(command, now, dt);
}

// -- services

std::string HandNode::stop() {
  is_stopped_ = true;
  if (!has_commands_)
    return handmap_disengage(hand_.get()) == HANDMAP_OK ? "" : handmap_last_error();
  const double now = steady_.now().seconds();
  const double dt = time_since_command(now);
  handmap_command command;
  if (handmap_stop(hand_.get(), dt, &command) != HANDMAP_OK) return handmap_last_error();
  publish(command, now, dt);
  return "";
}

std::string HandNode::clear() {
  if (!is_stopped_) return "no stop is in force";
  is_stopped_ = false;
  return "";
}

std::string HandNode::engage() {
  if (is_stopped_) return "an emergency stop is in force: call clear first";
  return handmap_engage(hand_.get()) == HANDMAP_OK ? "" : handmap_last_error();
}

std::string HandNode::disengage() {
  return handmap_disengage(hand_.get()) == HANDMAP_OK ? "" : handmap_last_error();
}

void HandNode::serve(const std::string& name, std::string (HandNode::*act)()) {
  services_.push_back(create_service<Trigger>(
      name, [this, act](const std::shared_ptr<Trigger::Request>,
                        std::shared_ptr<Trigger::Response> response) {
        response->message = (this->*act)();
        response->success = response->message.empty();
      }));
}

// -- commands

double HandNode::time_since_command(double now) const {
  if (!has_commands_) return usual_dt_;
  return std::min(std::max(now - last_command_, kShortestDt), kLongestIntervals * usual_dt_);
}

void HandNode::publish(const handmap_command& command, double now, double dt) {
  last_command_ = now;
  has_commands_ = true;
  const std::vector<double> q(command.q, command.q + command.joints);

  sensor_msgs::msg::JointState joints;
  joints.header.stamp = get_clock()->now();
  joints.header.frame_id = "handmap";
  joints.name = joint_names_;
  joints.position = q;

  geometry_msgs::msg::PoseStamped wrist;
  wrist.header = joints.header;
  wrist.pose.position.x = command.wrist[3];
  wrist.pose.position.y = command.wrist[7];
  wrist.pose.position.z = command.wrist[11];
  wrist.pose.orientation = quaternion_of(command.wrist);

  trajectory_msgs::msg::JointTrajectory trajectory;
  trajectory.header = joints.header;
  trajectory.joint_names = joint_names_;
  trajectory.points.resize(1);
  trajectory.points[0].positions = q;
  trajectory.points[0].time_from_start = rclcpp::Duration::from_seconds(dt);

  std_msgs::msg::Float64MultiArray forward;
  forward.data = q;

  joints_->publish(joints);
  wrist_->publish(wrist);
  trajectory_->publish(trajectory);
  forward_->publish(forward);
  const bool follows = command.status < HANDMAP_NO_SOLUTION && !is_stopped_;
  report(follows ? diagnostic_msgs::msg::DiagnosticStatus::OK
                 : diagnostic_msgs::msg::DiagnosticStatus::WARN,
         is_stopped_ ? "stopped" : handmap_status_name(command.status), command.rule);
}

void HandNode::report(unsigned char level, const std::string& text, const std::string& rule) {
  diagnostic_msgs::msg::DiagnosticArray array;
  array.header.stamp = get_clock()->now();
  array.status.resize(1);
  auto& status = array.status[0];
  status.level = level;
  status.name = "handmap";
  status.message = text;
  status.values.resize(2);
  status.values[0].key = "session";
  status.values[0].value = session_;
  status.values[1].key = "rule";
  status.values[1].value = rule;
  diagnostics_->publish(array);
}

void HandNode::warn(const std::string& problem) {
  RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 2000, "%s", problem.c_str());
}

}  // namespace handmap_ros2
