// Stand-in for ROS 2: the part of rclcpp that the node in C++ uses, with signatures as rclcpp's.
//
// What a node creates is kept by name, so that a test program calls its callbacks, and reads the
// messages that it publishes. Clocks stand still until the program sets `standin::time`.
#pragma once

#include <algorithm>
#include <any>
#include <chrono>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <builtin_interfaces/msg/time.hpp>

namespace standin {

inline double time = 0.0;                                  // of all clocks [s]
inline std::map<std::string, std::string> parameters;      // that are set
inline std::map<std::string, std::any> published;          // vectors of messages by topic
inline std::map<std::string, std::any> callbacks;          // by topic or service
inline std::function<void()> timer;
inline std::vector<std::string> warnings;

template <class Message>
std::vector<Message>& messages(const std::string& topic) {
  std::any& kept = published[topic];
  if (!kept.has_value()) kept = std::vector<Message>{};
  return std::any_cast<std::vector<Message>&>(kept);
}

}  // namespace standin

constexpr int RCL_STEADY_TIME = 3;

namespace rclcpp {

class Time {
 public:
  explicit Time(double seconds) : seconds_(seconds) {}
  Time(const builtin_interfaces::msg::Time& stamp) : seconds_(stamp.sec + 1e-9 * stamp.nanosec) {}
  double seconds() const { return seconds_; }
  operator builtin_interfaces::msg::Time() const {
    const auto whole = static_cast<int32_t>(seconds_);
    return {whole, static_cast<uint32_t>(1e9 * (seconds_ - whole))};
  }

 private:
  double seconds_;
};

class Duration {
 public:
  static Duration from_seconds(double seconds) { return Duration(seconds); }
  operator builtin_interfaces::msg::Duration() const {
    const auto whole = static_cast<int32_t>(seconds_);
    return {whole, static_cast<uint32_t>(1e9 * (seconds_ - whole))};
  }

 private:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds_;
};

class Clock {
 public:
  using SharedPtr = std::shared_ptr<Clock>;

  explicit Clock(int /*type*/ = 1) {}
  Time now() const { return Time(standin::time); }
};

class QoS {
 public:
  QoS(size_t /*depth*/) {}
  QoS& keep_last(size_t /*depth*/) { return *this; }
};

class SensorDataQoS : public QoS {
 public:
  SensorDataQoS() : QoS(5) {}
};

class Logger {};

template <class Message>
class Publisher {
 public:
  using SharedPtr = std::shared_ptr<Publisher>;

  explicit Publisher(std::string topic) : topic_(std::move(topic)) {}
  void publish(const Message& message) { standin::messages<Message>(topic_).push_back(message); }

 private:
  std::string topic_;
};

template <class Message>
class Subscription {
 public:
  using SharedPtr = std::shared_ptr<Subscription>;
};

template <class Kind>
class Service {
 public:
  using SharedPtr = std::shared_ptr<Service>;
};

class TimerBase {
 public:
  using SharedPtr = std::shared_ptr<TimerBase>;
};

class Node {
 public:
  explicit Node(const std::string& /*name*/) {}
  virtual ~Node() = default;

  template <class Value>
  Value declare_parameter(const std::string& name, const Value& fallback) {
    const auto found = standin::parameters.find(name);
    return found == standin::parameters.end() ? fallback : Value(found->second);
  }
  template <class Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string& topic, const QoS&) {
    return std::make_shared<Publisher<Message>>(topic);
  }
  template <class Message>
  typename Subscription<Message>::SharedPtr create_subscription(
      const std::string& topic, const QoS&,
      std::function<void(typename Message::ConstSharedPtr)> callback) {
    standin::callbacks[topic] = std::move(callback);
    return std::make_shared<Subscription<Message>>();
  }
  template <class Kind>
  typename Service<Kind>::SharedPtr create_service(
      const std::string& name, std::function<void(std::shared_ptr<typename Kind::Request>,
                                                  std::shared_ptr<typename Kind::Response>)>
                                   callback) {
    standin::callbacks[name] = std::move(callback);
    return std::make_shared<Service<Kind>>();
  }
  TimerBase::SharedPtr create_wall_timer(std::chrono::nanoseconds, std::function<void()> callback) {
    standin::timer = std::move(callback);
    return std::make_shared<TimerBase>();
  }
  Clock::SharedPtr get_clock() { return std::make_shared<Clock>(); }
  Logger get_logger() const { return {}; }
};

inline void init(int, char**) {}
inline void spin(std::shared_ptr<Node>) {}
inline void shutdown() {}

}  // namespace rclcpp

// The same text is kept once, whatever the period.
#define RCLCPP_WARN_THROTTLE(logger, clock, period, ...)                                       \
  do {                                                                                         \
    (void)(logger), (void)(clock), (void)(period);                                             \
    char text[512];                                                                            \
    std::snprintf(text, sizeof text, __VA_ARGS__);                                             \
    if (std::find(standin::warnings.begin(), standin::warnings.end(), text) ==                 \
        standin::warnings.end())                                                               \
      standin::warnings.push_back(text);                                                       \
  } while (false)
