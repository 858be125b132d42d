/* Made by dlkf.export; do not edit: the equations are in the Python package. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "step.h"

static inline double square(double x) { return x * x; }
static inline double cube(double x) { return x * x * x; }

/* L of S = L L', S symmetric and positive definite (m x m), else not a number */
static inline void factor(const int m, const double *S, double *L) {
  for (int i = 0; i < m; i++)
    for (int j = 0; j < m; j++) {
      if (j > i) { L[i * m + j] = 0; continue; }
      double x = S[i * m + j];
      for (int k = 0; k < j; k++) x -= L[i * m + k] * L[j * m + k];
      L[i * m + j] = i == j ? sqrt(x) : x / L[j * m + j];
    }
}

/* X (m x n) of L L' X = B */
static inline void back(const int m, const int n, const double *L, const double *B, double *X) {
  for (int i = 0; i < m; i++) {
    for (int j = 0; j < n; j++) X[i * n + j] = B[i * n + j];
    for (int k = 0; k < i; k++)
      if (L[i * m + k] != 0) /* many are: rows of what was not measured */
        for (int j = 0; j < n; j++) X[i * n + j] -= L[i * m + k] * X[k * n + j];
    const double r = 1 / L[i * m + i];
    for (int j = 0; j < n; j++) X[i * n + j] *= r;
  }
  for (int i = m - 1; i >= 0; i--) {
    for (int k = i + 1; k < m; k++)
      if (L[k * m + i] != 0)
        for (int j = 0; j < n; j++) X[i * n + j] -= L[k * m + i] * X[k * n + j];
    const double r = 1 / L[i * m + i];
    for (int j = 0; j < n; j++) X[i * n + j] *= r;
  }
}

static inline void solve(const int m, const int n, const double *S, const double *B, double *L, double *X) {
  factor(m, S, L);
  back(m, n, L, B, X);
}

static inline void invert3(const double *A, double *X) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
      X[i * 3 + j] = A[a * 3 + c] * A[b * 3 + d] - A[a * 3 + d] * A[b * 3 + c];
    }
  const double r = 1 / (A[0] * X[0] + A[1] * X[3] + A[2] * X[6]);
  for (int i = 0; i < 9; i++) X[i] *= r;
}
