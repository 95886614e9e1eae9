/* The limit to measure against: hand-written C for the pendulum, the double pendulum and the chain of n pendulums
 * (unit masses and lengths, Cartesian coordinates, index 1 by differentiation), and for sweeps of the double pendulum.
 * Every function integrates from t = 0 to t1 in place, with atol = rtol = tol, and returns the number of steps
 * tried, negative if it gave up. A lane of the sweep that fails ends in NaN. */
#include <math.h>
#include <pthread.h>

#define G 9.81
#define INLINE static inline __attribute__((always_inline))
#define LANES 8
typedef double vector __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));

INLINE vector pick(mask m, vector a, vector b) { return (vector)((m & (mask)a) | (~m & (mask)b)); }
INLINE double one_abs(double a) { return fabs(a); }
INLINE double one_max(double a, double b) { return a > b ? a : b; }
INLINE vector many_abs(vector a) { return (vector)((mask)a & 0x7fffffffffffffffLL); }
INLINE vector many_max(vector a, vector b) { return pick(a > b, a, b); }

#define T double
#define NAME(f) one_##f
#include "dop853.inc"
#undef T
#undef NAME
#define T vector
#define NAME(f) many_##f
#include "dop853.inc"

typedef void (*field_fn)(int, const double *, double *);
typedef void (*project_fn)(double *);

/* Factor of the next step from the squared error: 0.9 error^(-1/8) within [1/3, 6]. */
INLINE double growth(double error2)
{
    const double eighth = sqrt(sqrt(sqrt(sqrt(error2))));
    return 0.9 / (eighth < 0.15 ? 0.15 : eighth > 2.7 ? 2.7 : eighth);
}

/* First step: tol^(1/8) times the time in which the acceleration changes the state by its own size. */
INLINE double first_step(int n, const double *dy, double tol, double t1)
{
    double size = 0;
    for (int i = 0; i < n; i++) size += dy[i] * dy[i];
    return fmin(t1, sqrt(sqrt(sqrt(tol))) / (1 + sqrt(size / n)));
}

INLINE int solve(int n, field_fn field, project_fn project, double *y, double t1, double tol)
{
    double k[12 * n], z[n], t = 0;
    int steps = 0;
    field(n, y, k);
    double h = first_step(n, k, tol, t1);
    while (t < t1) {
        if (t + h > t1 - 1e-14 * t1) h = t1 - t;
        const double error2 = one_step(n, field, y, h, tol, k, z);
        if (error2 <= 1) {
            t = h == t1 - t ? t1 : t + h;
            if (project) project(z);
            for (int i = 0; i < n; i++) y[i] = z[i];
            field(n, y, k);
        } else if (!(h > 1e-14) || isnan(error2)) {
            return -1 - steps;
        }
        h *= growth(error2);
        steps++;
    }
    return steps;
}

/* ---- pendulum: r'' = (0, g) - F r ---- */

INLINE void pendulum_field(int n, const double *y, double *dy)
{
    const double F = (y[2] * y[2] + y[3] * y[3] + G * y[1]) / (y[0] * y[0] + y[1] * y[1]);
    dy[0] = y[2];
    dy[1] = y[3];
    dy[2] = -F * y[0];
    dy[3] = G - F * y[1];
}

INLINE void pendulum_project(double *y)
{
    const double scale = 1 / sqrt(y[0] * y[0] + y[1] * y[1]);
    y[0] *= scale;
    y[1] *= scale;
    const double radial = y[0] * y[2] + y[1] * y[3];
    y[2] -= radial * y[0];
    y[3] -= radial * y[1];
}

/* ---- double pendulum ---- */

/* y += G(q)^T (G(q) G(q)^T)^-1 (p, s) for the part y of the state: positions or velocities. */
INLINE void correct(const double *q, double p, double s, double *y)
{
    const double dx = q[2] - q[0], dz = q[3] - q[1], a = q[0] * q[0] + q[1] * q[1], b = q[0] * dx + q[1] * dz;
    const double c = 2 * (dx * dx + dz * dz), det = 1 / (a * c - b * b);
    const double u = det * (c * p + b * s), v = det * (b * p + a * s);
    y[0] += u * q[0] - v * dx;
    y[1] += u * q[1] - v * dz;
    y[2] += v * dx;
    y[3] += v * dz;
}

/* Newton's method for the nearest positions with |r1| = |d| = 1, then the nearest velocities tangent to them. */
INLINE void double_pendulum_project(double *y)
{
    for (int i = 0; i < 3; i++) {
        const double dx = y[2] - y[0], dz = y[3] - y[1];
        const double p = (1 - y[0] * y[0] - y[1] * y[1]) / 2, s = (1 - dx * dx - dz * dz) / 2;
        if (fmax(fabs(p), fabs(s)) < 1e-14) break;
        correct(y, p, s, y);
    }
    const double dx = y[2] - y[0], dz = y[3] - y[1];
    correct(y, -y[0] * y[4] - y[1] * y[5], -dx * (y[6] - y[4]) - dz * (y[7] - y[5]), y + 4);
}

/* ---- chain of n pendulums, state (x, z, x', z') with n of each ---- */

/* Links d_i = r_i - r_(i-1). The multipliers solve the tridiagonal system with diagonal c_i |d_i|^2 (c_1 = 1, else 2),
 * off-diagonal -d_i . d_(i+1) and right-hand side |d_i'|^2 (+ g z_1), halved here so that determinants do not overflow.
 * Determinants of the leading and trailing blocks, l and r, need no division: both recurrences run at the same time,
 * and F_i = (u_i r_(i+1) + w_i l_i - s_i l_i r_(i+1)) / det. */
INLINE void chain_field(int size, const double *y, double *dy)
{
    const int n = size / 4;
    const double *x = y, *z = y + n, *vx = y + 2 * n, *vz = y + 3 * n;
    double dx[n + 1], dz[n + 1], a[n], b[n + 1], s[n], l[n + 2], r[n + 2], u[n + 1], w[n + 1], F[n + 1];
    dx[0] = x[0], dz[0] = z[0], dx[n] = dz[n] = 0;
    for (int i = 1; i < n; i++) dx[i] = x[i] - x[i - 1], dz[i] = z[i] - z[i - 1];
    for (int i = 0; i < n; i++) {
        a[i] = dx[i] * dx[i] + dz[i] * dz[i];
        b[i + 1] = (dx[i] * dx[i + 1] + dz[i] * dz[i + 1]) / 2;
    }
    s[0] = (vx[0] * vx[0] + vz[0] * vz[0] + G * z[0]) / 2;
    for (int i = 1; i < n; i++) {
        const double wx = vx[i] - vx[i - 1], wz = vz[i] - vz[i - 1];
        s[i] = (wx * wx + wz * wz) / 2;
    }
    a[0] /= 2, b[0] = 0;
    /* l[i + 1]: determinant of links 0..i (l[0] = 1 is the empty one); r[i]: of links i..n-1 */
    l[0] = r[n] = 1, l[1] = a[0], r[n - 1] = a[n - 1], u[0] = s[0], w[n - 1] = s[n - 1];
    for (int i = 1, j = n - 2; i < n; i++, j--) {
        l[i + 1] = fma(a[i], l[i], -(b[i] * b[i] * l[i - 1]));
        r[j] = fma(a[j], r[j + 1], -(b[j + 1] * b[j + 1] * r[j + 2]));
        u[i] = fma(b[i], u[i - 1], s[i] * l[i]);
        w[j] = fma(b[j + 1], w[j + 1], s[j] * r[j + 1]);
    }
    const double det = 1 / l[n];
    for (int i = 0; i < n; i++) F[i] = det * (u[i] * r[i + 1] + w[i] * l[i] - s[i] * l[i] * r[i + 1]);
    F[n] = 0;
    for (int i = 0; i < 2 * n; i++) dy[i] = y[2 * n + i];
    for (int i = 0; i < n; i++) {
        dy[2 * n + i] = F[i + 1] * dx[i + 1] - F[i] * dx[i];
        dy[3 * n + i] = F[i + 1] * dz[i + 1] - F[i] * dz[i] + G;
    }
}

int pendulum(double *y, double t1, double tol, int project)
{
    return project ? solve(4, pendulum_field, pendulum_project, y, t1, tol) : solve(4, pendulum_field, 0, y, t1, tol);
}

int double_pendulum(double *y, double t1, double tol, int project)
{
    return project ? solve(8, one_double_pendulum_field, double_pendulum_project, y, t1, tol)
                   : solve(8, one_double_pendulum_field, 0, y, t1, tol);
}

int chain(int n, double *y, double t1, double tol) { return solve(4 * n, chain_field, 0, y, t1, tol); }

/* ---- sweep: LANES double pendulums at a time in each thread; a lane that is done takes the next one ---- */

struct sweep { double *ys, t1, tol; long count, next, steps; };

static void *work(void *arg)
{
    struct sweep *job = arg;
    vector y[8] = {}, z[8], k[12 * 8], last[8], h = {}, t = {};
    long lane[LANES], steps = 0, busy = LANES;
    for (int j = 0; j < LANES; j++) lane[j] = -1, t[j] = job->t1, y[0][j] = 1, y[2][j] = 2;  /* sound even if idle */
    for (mask done = ~(mask){};;) {
        for (int j = 0; j < LANES; j++) {
            if (!done[j]) continue;
            for (int i = 0; i < 8 && lane[j] >= 0; i++) job->ys[8 * lane[j] + i] = y[i][j];
            lane[j] = __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED);
            if (lane[j] >= job->count) {
                lane[j] = -1, t[j] = -INFINITY, h[j] = 0, busy--;
                continue;
            }
            double start[8], slope[8];
            for (int i = 0; i < 8; i++) y[i][j] = start[i] = job->ys[8 * lane[j] + i];
            one_double_pendulum_field(8, start, slope);
            for (int i = 0; i < 8; i++) k[i][j] = slope[i];
            t[j] = 0, h[j] = first_step(8, slope, job->tol, job->t1);
        }
        if (busy == 0) break;
        const mask final = ~(t + h < job->t1);  /* a NaN ends its lane, and is seen in the result */
        h = pick(final, job->t1 - t, h);
        const vector error2 = many_step(8, many_double_pendulum_field, y, h, job->tol, k, z);
        many_double_pendulum_field(8, z, last);
        const mask accept = ~(error2 > 1);
        done = accept & final;
        for (int i = 0; i < 8; i++) y[i] = pick(accept, z[i], y[i]), k[i] = pick(accept, last[i], k[i]);
        t = pick(accept, t + h, t);
        for (int j = 0; j < LANES; j++) h[j] *= growth(error2[j]);
        steps += busy;
    }
    __atomic_fetch_add(&job->steps, steps, __ATOMIC_RELAXED);
    return 0;
}

long sweep(long count, double *ys, double t1, double tol, int threads)
{
    struct sweep job = {ys, t1, tol, count, 0, 0};
    pthread_t others[threads];
    for (int i = 1; i < threads; i++) pthread_create(others + i, 0, work, &job);
    work(&job);
    for (int i = 1; i < threads; i++) pthread_join(others[i], 0);
    return job.steps;
}
