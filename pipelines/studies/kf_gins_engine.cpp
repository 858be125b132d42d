/* KF-GINS' engine over a drive in memory, timed without files: kf_gins_engine drive.bin.
 *
 * Numbers of drive.bin, all double: how many samples and fixes, lever arm (3); start: latitude, longitude [rad], height [m],
 * velocity NED (3), roll, pitch, yaw [rad], and the 1-sigma of those nine; noise of gyroscopes, accelerometers, spread of their
 * biases and scale factors (2 + 2 + 2), correlation time; samples: time, angle (3), velocity (3) gained; fixes: time, latitude,
 * longitude, height, 1-sigma (3). Prints processor seconds of the loop, then latitude, longitude, height at its end. */
#include <cstdio>
#include <ctime>
#include <vector>

#include "kf-gins/gi_engine.h"

static Eigen::Vector3d three(const double *x) { return {x[0], x[1], x[2]}; }
static Eigen::Vector3d same(double x) { return {x, x, x}; }

int main(int, char **argument) {
  FILE *file = fopen(argument[1], "rb");
  std::vector<double> x;
  double part[4096];
  for (size_t n; (n = fread(part, sizeof(double), 4096, file)) > 0;) x.insert(x.end(), part, part + n);
  const size_t samples = size_t(x[0]), fixes = size_t(x[1]);
  const double *start = &x[5], *sigma = &x[14], *noise = &x[23], *imu = &x[30], *fix = imu + 7 * samples;
  GINSOptions options;
  const Eigen::Vector3d zero = same(0);
  options.initstate = {three(start), three(start + 3), three(start + 6), {zero, zero, zero, zero}};
  options.initstate_std = {three(sigma), three(sigma + 3), three(sigma + 6),
                        {same(noise[2]), same(noise[3]), same(noise[4]), same(noise[5])}};
  options.imunoise = {same(noise[0]), same(noise[1]), same(noise[2]), same(noise[3]), same(noise[4]), same(noise[5]), noise[6]};
  options.antlever = three(&x[2]);

  GIEngine engine(options);
  size_t next = 0;
  const clock_t began = clock();
  for (size_t k = 0; k < samples; k++, imu += 7) {
    IMU sample{imu[0], k ? imu[0] - imu[-7] : imu[7] - imu[0], three(imu + 1), three(imu + 4), 0};
    while (next < fixes && fix[7 * next] < sample.time) {
      const double *f = fix + 7 * next++;
      engine.addGnssData({f[0], three(f + 1), three(f + 4), true});
    }
    if (k == 0) engine.addImuData(sample, true);
    else engine.addImuData(sample), engine.newImuProcess();
  }
  const double seconds = double(clock() - began) / CLOCKS_PER_SEC;
  const NavState end = engine.getNavState();
  printf("%.9g %.12g %.12g %.6f\n", seconds, end.pos[0], end.pos[1], end.pos[2]);
}
