/* Ten hours in circles through the core, one call in twenty faulty: what it allocates, how much memory the process had
 * then and now, and how far off it ends.
 *
 * malloc and its kin are this program's own, so that those of every library in the process are counted too. */
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <sys/resource.h>

#include "dlkf.h"

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t), *__libc_memalign(size_t, size_t);
static long allocations;
void *malloc(size_t n) { allocations++; return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { allocations++; return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { allocations++; return __libc_realloc(p, n); }
void *memalign(size_t a, size_t n) { allocations++; return __libc_memalign(a, n); }
void *aligned_alloc(size_t a, size_t n) { allocations++; return __libc_memalign(a, n); }
int posix_memalign(void **p, size_t a, size_t n) { allocations++; return !(*p = __libc_memalign(a, n)); }

enum { HOURS = 10, IMU_HZ = 50, FAULTY = 20 };
static const double SPEED = 10, RATE = 0.1, LAT = 0.85, LON = 0.15, PI = 3.14159265358979323846;
static dlkf filter;

static unsigned drawn(unsigned below) { /* xorshift */
  static unsigned x = 2463534242u;
  x ^= x << 13, x ^= x >> 17, x ^= x << 5;
  return x % below;
}

static void fix_at(double t, double *fix) { /* latitude, longitude, height, velocity */
  const double e2 = 6.69437999014e-3, w2 = 1 - e2 * sin(LAT) * sin(LAT), N = 6378137 / sqrt(w2), M = N * (1 - e2) / w2;
  const double yaw = RATE * t, north = SPEED / RATE * sin(yaw), east = SPEED / RATE * (1 - cos(yaw));
  fix[0] = (LAT + north / (M + 100)) * 180 / PI;
  fix[1] = (LON + east / ((N + 100) * cos(LAT))) * 180 / PI;
  fix[2] = 100;
  fix[3] = SPEED * cos(yaw), fix[4] = SPEED * sin(yaw), fix[5] = 0;
}

static double wrong(double x) { /* a number in the place of another */
  static const double values[] = {NAN, INFINITY, -INFINITY, 1e300, -1e30, 0, 1e9, -1};
  const unsigned k = drawn(10);
  return k < 8 ? values[k] : x + (k == 8 ? 30 : -0.5);
}

int main(void) {
  const double std[6] = {1, 1, 1, 0.1, 0.1, 0.1}, arm[3] = {0, 0, 0};
  struct rusage early = {0}, late;
  long counted = 0, rows = 0, faults = 0;
  double fix[6], last[DLKF_COLUMNS] = {0};
  dlkf_open(&filter, arm);
  for (long k = 1; k <= HOURS * 3600L * IMU_HZ; k++) {
    if (k == 120L * IMU_HZ) counted = allocations, getrusage(RUSAGE_SELF, &early);
    const double noise = 1e-4 * ((int)drawn(201) - 100); /* the same numbers again would be those of a frozen IMU */
    double t = (double)k / IMU_HZ, accel[3] = {noise, SPEED * RATE, -9.81}, gyro[3] = {0, 0, RATE};
    if (k % IMU_HZ == 0) {
      double stamp = t, v[3];
      fix_at(t, fix);
      for (int c = 0; c < 3; c++) v[c] = fix[3 + c];
      if (!drawn(FAULTY)) { /* of its stamp, position or velocity: what a receiver's protocol lets through */
        const unsigned place = drawn(3);
        faults++;
        if (place == 0) stamp = wrong(t);
        else if (place == 1) fix[drawn(2)] = 95 + 1e3 * drawn(9);
        else v[drawn(3)] = NAN;
      }
      dlkf_gnss(&filter, stamp, fix[0], fix[1], fix[2], v, std, 4);
    }
    int twice = 0;
    if (!drawn(FAULTY)) {
      const unsigned place = drawn(8);
      faults++;
      if (place == 0) continue; /* lost */
      twice = place == 1;
      if (place == 2) dlkf_imu(&filter, wrong(t) > 1e8 ? NAN : t - 1, accel, gyro); /* a stamp */
      else if (place > 2 && place < 5) dlkf_imu(&filter, t, (double[]){NAN, 0, 1e9}, gyro);
      else if (place > 4) dlkf_imu(&filter, t, accel, (double[]){1e6, INFINITY, 0});
    }
    dlkf_imu(&filter, t, accel, gyro);
    for (const double *row; (row = dlkf_next(&filter)); rows++)
      for (int c = 0; c < DLKF_COLUMNS; c++) last[c] = row[c];
    if (twice) dlkf_imu(&filter, t, accel, gyro);
  }
  getrusage(RUSAGE_SELF, &late);
  fix_at(last[DLKF_T], fix);
  const double off = hypot((last[DLKF_LAT_DEG] - fix[0]) * 111e3, (last[DLKF_LON_DEG] - fix[1]) * 111e3 * cos(LAT));
  counted = allocations - counted;
  printf("%ld rows, %ld faults, %ld allocations, %ld kB more, %.3f m off\n", rows, faults, counted, late.ru_maxrss - early.ru_maxrss, off);
  return 0;
}
