/* Vectors, rotations and the WGS-84 ellipsoid in the few forms that the core takes: matrices by rows, double. */
#ifndef DLKF_GEOMETRY_H
#define DLKF_GEOMETRY_H

#include <math.h>

#include "constants.h"

static inline double square_of(double x) { return x * x; }

static inline double dot3(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline void cross3(const double *a, const double *b, double *out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

/* out = A u */
static inline void apply3(const double *A, const double *u, double *out) {
  for (int i = 0; i < 3; i++) out[i] = dot3(A + 3 * i, u);
}

/* out = A' u */
static inline void apply3_transposed(const double *A, const double *u, double *out) {
  for (int i = 0; i < 3; i++) out[i] = A[i] * u[0] + A[3 + i] * u[1] + A[6 + i] * u[2];
}

/* out = A B; out is neither */
static inline void product3(const double *A, const double *B, double *out) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
}

/* out = A' B; out is neither */
static inline void product3_transposed(const double *A, const double *B, double *out) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[3 * i + j] = A[i] * B[j] + A[3 + i] * B[3 + j] + A[6 + i] * B[6 + j];
}

/* exp([phi x]) through the quaternion (dlkf: rotation_from_vector) */
static inline void rotation_of(const double *phi, double *C) {
  const double half = sqrt(0.25 * dot3(phi, phi) + 1e-30), s = 0.5 * sin(half) / half;
  const double w = cos(half), x = s * phi[0], y = s * phi[1], z = s * phi[2];
  C[0] = w * w + x * x - y * y - z * z, C[1] = 2 * (x * y - w * z), C[2] = 2 * (x * z + w * y);
  C[3] = 2 * (x * y + w * z), C[4] = w * w - x * x + y * y - z * z, C[5] = 2 * (y * z - w * x);
  C[6] = 2 * (x * z - w * y), C[7] = 2 * (y * z + w * x), C[8] = w * w - x * x - y * y + z * z;
}

/* C = Rz(yaw) Ry(pitch) Rx(roll) (Groves 2.22 transposed) */
static inline void rotation_from_rpy(double roll, double pitch, double yaw, double *C) {
  const double cr = cos(roll), sr = sin(roll), cp = cos(pitch), sp = sin(pitch), cy = cos(yaw), sy = sin(yaw);
  C[0] = cp * cy, C[1] = sr * sp * cy - cr * sy, C[2] = cr * sp * cy + sr * sy;
  C[3] = cp * sy, C[4] = sr * sp * sy + cr * cy, C[5] = cr * sp * sy - sr * cy;
  C[6] = -sp, C[7] = sr * cp, C[8] = cr * cp;
}

/* ECEF position [m] (Groves 2.112) of latitude, longitude [rad] and height [m] */
static inline void ecef_from_geodetic(double lat, double lon, double height, double *r_e) {
  const double radius = SEMI_MAJOR / sqrt(1 - ECCENTRICITY_SQ * sin(lat) * sin(lat));
  r_e[0] = (radius + height) * cos(lat) * cos(lon);
  r_e[1] = (radius + height) * cos(lat) * sin(lon);
  r_e[2] = ((1 - ECCENTRICITY_SQ) * radius + height) * sin(lat);
}

/* Latitude, longitude [rad] and height [m] of an ECEF position: Bowring 1976, twice, which is exact to rounding */
static inline void geodetic_from_ecef(const double *r_e, double *lat, double *lon, double *height) {
  const double level = hypot(r_e[0], r_e[1]), z = r_e[2];
  double sine = SEMI_MAJOR * z, cosine = SEMI_MINOR * level, phi = 0;
  for (int k = 0; k < 2; k++) {
    const double reduced = atan2(sine, cosine), s = sin(reduced), c = cos(reduced);
    phi = atan2(z + ECCENTRICITY_SQ / (1 - ECCENTRICITY_SQ) * SEMI_MINOR * s * s * s,
                level - ECCENTRICITY_SQ * SEMI_MAJOR * c * c * c);
    sine = SEMI_MINOR * sin(phi), cosine = SEMI_MAJOR * cos(phi);
  }
  *lat = phi;
  *lon = atan2(r_e[1], r_e[0]);
  *height = level * cos(phi) + z * sin(phi) - SEMI_MAJOR * sqrt(1 - ECCENTRICITY_SQ * sin(phi) * sin(phi));
}

/* C_en: columns are North, East and Down in ECEF (Groves 2.150 transposed) */
static inline void ned_axes(double lat, double lon, double *C_en) {
  const double sl = sin(lat), cl = cos(lat), so = sin(lon), co = cos(lon);
  C_en[0] = -sl * co, C_en[1] = -so, C_en[2] = -cl * co;
  C_en[3] = -sl * so, C_en[4] = co, C_en[5] = -cl * so;
  C_en[6] = cl, C_en[7] = 0, C_en[8] = -sl;
}

/* Magnitude of WGS-84 normal gravity [m/s2] (Somigliana; Groves 2.134, 2.139) */
static inline double normal_gravity(double sin_lat, double height) {
  const double s2 = sin_lat * sin_lat;
  const double surface = GRAVITY_EQUATOR * (1 + SOMIGLIANA * s2) / sqrt(1 - ECCENTRICITY_SQ * s2);
  const double m = EARTH_RATE * EARTH_RATE * SEMI_MAJOR * SEMI_MAJOR * SEMI_MINOR / GRAVITATIONAL_CONSTANT;
  const double flattening = 1 - SEMI_MINOR / SEMI_MAJOR;
  const double slope = 2 / SEMI_MAJOR * (1 + flattening * (1 - 2 * s2) + m);
  return surface * (1 - slope * height + 3 / (SEMI_MAJOR * SEMI_MAJOR) * height * height);
}

/* Mean of n vectors, six numbers apart */
static inline void mean3(const double *x, int n, double *out) {
  out[0] = out[1] = out[2] = 0;
  for (int k = 0; k < n; k++)
    for (int c = 0; c < 3; c++) out[c] += x[6 * k + c];
  for (int c = 0; c < 3; c++) out[c] /= n;
}

static inline double arcsine(double x) { return asin(x > 1 ? 1 : x < -1 ? -1 : x); }

/* Roll and pitch with Ry(pitch) Rx(roll) u_b = u_h, u_h in level axes along the heading. */
static inline void level3(const double *u_b, const double *u_h, double *roll, double *pitch) {
  *roll = arcsine(u_h[1] / hypot(u_b[1], u_b[2])) - atan2(u_b[1], -u_b[2]);
  const double down = sin(*roll) * u_b[1] + cos(*roll) * u_b[2];
  *pitch = atan2(u_b[0], -down) - arcsine(u_h[0] / hypot(u_b[0], down));
}

#endif
