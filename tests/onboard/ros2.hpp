// What ros2_node.cpp takes of ROS 2, as its interfaces are published: messages are handed over at once, in one thread.
#pragma once
#include <array>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace builtin_interfaces::msg { struct Time { int sec; unsigned nanosec; }; }
namespace std_msgs::msg { struct Header { builtin_interfaces::msg::Time stamp; std::string frame_id; }; }
#define MESSAGE(M) using SharedPtr = std::shared_ptr<M>; using ConstSharedPtr = std::shared_ptr<const M>; std_msgs::msg::Header header

namespace geometry_msgs::msg {
struct Vector3 { double x, y, z; };
struct Point { double x, y, z; };
struct Quaternion { double x, y, z, w; };
struct Pose { Point position; Quaternion orientation; };
struct Twist { Vector3 linear, angular; };
struct PoseWithCovariance { Pose pose; std::array<double, 36> covariance; };
struct TwistWithCovariance { Twist twist; std::array<double, 36> covariance; };
struct TwistWithCovarianceStamped { MESSAGE(TwistWithCovarianceStamped); TwistWithCovariance twist; };
struct TwistStamped { MESSAGE(TwistStamped); Twist twist; };
struct QuaternionStamped { MESSAGE(QuaternionStamped); Quaternion quaternion; };
}
namespace nav_msgs::msg {
struct Odometry {
  MESSAGE(Odometry);
  std::string child_frame_id;
  geometry_msgs::msg::PoseWithCovariance pose;
  geometry_msgs::msg::TwistWithCovariance twist;
};
}
namespace sensor_msgs::msg {
struct Imu { MESSAGE(Imu); geometry_msgs::msg::Quaternion orientation; geometry_msgs::msg::Vector3 angular_velocity, linear_acceleration; };
struct FluidPressure { MESSAGE(FluidPressure); double fluid_pressure, variance; };
struct NavSatStatus { signed char status; unsigned short service; };
struct NavSatFix {
  MESSAGE(NavSatFix);
  NavSatStatus status;
  double latitude, longitude, altitude;
  std::array<double, 9> position_covariance;
  unsigned char position_covariance_type;
};
}
namespace rclcpp {
struct Time {
  double t;
  explicit Time(const builtin_interfaces::msg::Time& stamp) : t(stamp.sec + 1e-9 * stamp.nanosec) {}
  double seconds() const { return t; }
};
template <class M> std::map<std::string, std::function<void(std::shared_ptr<const M>)>> heard;  // by topic
template <class M> std::function<void(const M&)> said;
inline std::vector<double> parameter;
template <class M> struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
template <class M> struct Publisher { using SharedPtr = std::shared_ptr<Publisher>; void publish(const M& m) { said<M>(m); } };
struct Node {
  explicit Node(const std::string&) {}
  std::vector<double> declare_parameter(const std::string&, const std::vector<double>&) { return parameter; }
  template <class M> typename Subscription<M>::SharedPtr create_subscription(const std::string& topic, int, std::function<void(std::shared_ptr<const M>)> call) {
    heard<M>[topic] = call;
    return nullptr;
  }
  template <class M> typename Publisher<M>::SharedPtr create_publisher(const std::string&, int) { return std::make_shared<Publisher<M>>(); }
};
void init(int, char**);
void spin(std::shared_ptr<Node>);
void shutdown();
}
