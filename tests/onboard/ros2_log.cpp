// The ROS 2 node over the lines of navigate.c, turned to ROS 2's axes: ./go arm_x arm_y arm_z < drive.csv > odometry.csv
#include "ros2_node.cpp"

#include <cstdio>
#include <cstdlib>
#include <cstring>

namespace {
builtin_interfaces::msg::Time stamp(double t) { return {(int)std::floor(t), (unsigned)std::lround(1e9 * (t - std::floor(t)))}; }
template <class M> void tell(const char* topic, const M& message) { rclcpp::heard<M>.at(topic)(std::make_shared<M>(message)); }
}

void rclcpp::init(int, char** arguments) {
  for (int k = 1; k < 4; k++) parameter.push_back(std::atof(arguments[k]));
  said<nav_msgs::msg::Odometry> = [](const nav_msgs::msg::Odometry& m) {
    const auto& p = m.pose.pose.position;
    const auto& q = m.pose.pose.orientation;
    const auto& v = m.twist.twist.linear;
    std::printf("%.9f", Time(m.header.stamp).seconds());
    for (double x : {p.x, p.y, p.z, q.w, q.x, q.y, q.z, v.x, v.y, v.z}) std::printf(",%.12g", x);
    std::putchar('\n');
  };
}
void rclcpp::shutdown() {}
void rclcpp::spin(std::shared_ptr<Node>) {
  char line[1024];
  while (std::fgets(line, sizeof line, stdin)) {
    double x[14];
    int n = 0;
    for (char* word = std::strchr(line, ','); word && n < 14; word = std::strchr(word + 1, ',')) x[n++] = std::strtod(word + 1, nullptr);
    if (line[0] == 'i') {
      sensor_msgs::msg::Imu m{};
      m.header.stamp = stamp(x[0]);
      m.linear_acceleration = {x[1], -x[2], -x[3]};
      m.angular_velocity = {x[4], -x[5], -x[6]};
      tell("imu/data", m);
    } else if (line[0] == 's') {
      geometry_msgs::msg::TwistStamped m{};
      m.header.stamp = stamp(x[0]);
      m.twist.linear.x = x[1];
      tell("wheel", m);
    } else if (line[0] == 'h') {
      geometry_msgs::msg::QuaternionStamped m{};
      m.header.stamp = stamp(x[0]);
      m.quaternion = {0, 0, std::sin((M_PI / 2 - x[1]) / 2), std::cos((M_PI / 2 - x[1]) / 2)};
      tell("heading", m);
    } else if (line[0] == 'b') {
      sensor_msgs::msg::FluidPressure m{};
      m.header.stamp = stamp(x[0]);
      m.fluid_pressure = 101325 * std::pow(1 - x[1] / 44330.77, 1 / 0.190263);
      tell("pressure", m);
    } else {
      sensor_msgs::msg::NavSatFix fix{};
      geometry_msgs::msg::TwistWithCovarianceStamped velocity{};
      fix.header.stamp = velocity.header.stamp = stamp(x[0]);
      fix.latitude = x[1], fix.longitude = x[2], fix.altitude = x[3];
      fix.position_covariance = {x[8] * x[8], 0, 0, 0, x[7] * x[7], 0, 0, 0, x[9] * x[9]};
      fix.position_covariance_type = 2;
      velocity.twist.twist.linear = {x[5], x[4], -x[6]};
      if ((int)x[0] % 2) tell("fix_velocity", velocity);  // in either order
      tell("fix", fix);
      if ((int)x[0] % 2 == 0) tell("fix_velocity", velocity);
    }
  }
}
