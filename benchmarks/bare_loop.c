/* SPDX-License-Identifier: MIT */
/* The least a closed-loop simulation can be: one PI controller in float and one stationary-flux RK4 step in double
 * per period, two outputs, everything in registers of one function. benchmarks/simulation.py compiles it with the
 * kernel's own flags and times both in one process; nothing else uses it.
 */
#include <stdint.h>

typedef struct {
    double R_s, L_d, L_q, psi_f, U_dc, omega_e, T_s;
    double K_p_d, K_p_q, K_i;
    double i_d_ref, i_q_ref;
} bare_setup;

static inline void sine_cosine_float(float x, float *s, float *c)
{
    const float q = x * 0.636619772F;
    const int32_t k = (int32_t)(q + (q < 0.0F ? -0.5F : 0.5F));
    const float n = (float)k, r = ((x - n * 1.570556640625F) - n * 0.000239670276641845703125F) - n * 1.5893254e-8F;
    const float z = r * r;
    const float sr = r + r * z * (-0.16666651F + z * (0.00833197F + z * -0.00019495F));
    const float cr = 1.0F - 0.5F * z + z * z * (0.0416666467F + z * (-0.00138873614F + z * 2.443773e-5F));
    const float first = (k & 1) ? cr : sr, second = (k & 1) ? sr : cr;
    *s = (k & 2) ? -first : first;
    *c = ((k + 1) & 2) ? -second : second;
}

static inline void sine_cosine(double x, double *s, double *c)
{
    const double q = x * 0.63661977236758134308;
    const int64_t k = (int64_t)(q < 0.0 ? q - 0.5 : q + 0.5);
    const double n = (double)k, r = (x - n * 1.5707963267341256) - n * 6.077100506506192e-11, z = r * r;
    const double sr = r + r * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0
                    + z * (-1.0 / 39916800.0 + z * (1.0 / 6227020800.0 + z * (-1.0 / 1307674368000.0)))))));
    const double cr = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40320.0
                    + z * (-1.0 / 3628800.0 + z * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0)))))));
    const double first = (k & 1) ? cr : sr, second = (k & 1) ? sr : cr;
    *s = (k & 2) ? -first : first;
    *c = ((k + 1) & 2) ? -second : second;
}

static inline float clip(float x)
{
    return x > 1.0F ? 1.0F : (x < 0.0F ? 0.0F : x);
}

__attribute__((visibility("default"))) void bare_run(const bare_setup *p, uint64_t n, double *out)
{
    const double two_pi = 6.28318530717958647693, pi = 0.5 * two_pi, h = p->T_s, half = 0.5 * h;
    double psi_a = p->psi_f, psi_b = 0.0, theta = 0.0, c = 1.0, s = 0.0, i_d = 0.0, i_q = 0.0;
    double half_c, half_s, full_c, full_s, u_a = 0.0, u_b = 0.0;
    const float R3 = 1.7320508F, T_s = (float)h, w = (float)p->omega_e, U = (float)p->U_dc;
    const float K_p_d = (float)p->K_p_d, K_p_q = (float)p->K_p_q, K_i = (float)p->K_i;
    float x_d = 0.0F, x_q = 0.0F;
    sine_cosine(p->omega_e * half, &half_s, &half_c);
    sine_cosine(p->omega_e * h, &full_s, &full_c);
    for (uint64_t k = 0; k < n; k++) {
        /* sample and control */
        const double ia = c * i_d - s * i_q, ib = s * i_d + c * i_q;
        const float fa = (float)ia, fb = (float)(-0.5 * ia + 0.86602540378443864676 * ib);
        const float fc = (float)(-0.5 * ia - 0.86602540378443864676 * ib), angle = (float)theta;
        const float al = (2.0F * fa - fb - fc) * (1.0F / 3.0F), be = (fb - fc) * (1.0F / R3);
        float sf, cf, so, co;
        sine_cosine_float(angle, &sf, &cf);
        sine_cosine_float(angle + 1.5F * w * T_s, &so, &co);
        const float d = cf * al + sf * be, q = cf * be - sf * al;
        const float e_d = (float)p->i_d_ref - d, e_q = (float)p->i_q_ref - q;
        const float u_d = K_p_d * e_d + x_d - w * (float)p->L_q * q;
        const float u_q = K_p_q * e_q + x_q + w * ((float)p->L_d * d + (float)p->psi_f);
        const float va = co * u_d - so * u_q, vb = so * u_d + co * u_q;
        const float a = va, b = -0.5F * va + 0.5F * R3 * vb, cc = -0.5F * va - 0.5F * R3 * vb;
        const float high = a > b ? (a > cc ? a : cc) : (b > cc ? b : cc), low = a < b ? (a < cc ? a : cc) : (b < cc ? b : cc);
        const float mid = 0.5F * (high + low), inverse = 1.0F / U;
        const float da = clip(0.5F + (a - mid) * inverse), db = clip(0.5F + (b - mid) * inverse);
        const float dc = clip(0.5F + (cc - mid) * inverse);
        const float ra = U * (2.0F * da - db - dc) * (1.0F / 3.0F), rb = U * (db - dc) * (1.0F / R3);
        x_d += T_s * K_i * (e_d + (co * ra + so * rb - u_d) / K_p_d);
        x_q += T_s * K_i * (e_q + (co * rb - so * ra - u_q) / K_p_q);
        out[2 * k] = i_d;
        out[2 * k + 1] = i_q;
        /* plant under the voltage of the previous period */
        const double mc = c * half_c - s * half_s, ms = s * half_c + c * half_s;
        const double lc = c * full_c - s * full_s, ls = s * full_c + c * full_s;
#define RATE(PA, PB, C, S, KA, KB)                                                       \
    do {                                                                                 \
        const double id = (C * (PA) + S * (PB) - p->psi_f) / p->L_d;                     \
        const double iq = (C * (PB) - S * (PA)) / p->L_q;                                \
        KA = u_a - p->R_s * (C * id - S * iq);                                           \
        KB = u_b - p->R_s * (S * id + C * iq);                                           \
    } while (0)
        double k1a, k1b, k2a, k2b, k3a, k3b, k4a, k4b;
        RATE(psi_a, psi_b, c, s, k1a, k1b);
        RATE(psi_a + half * k1a, psi_b + half * k1b, mc, ms, k2a, k2b);
        RATE(psi_a + half * k2a, psi_b + half * k2b, mc, ms, k3a, k3b);
        RATE(psi_a + h * k3a, psi_b + h * k3b, lc, ls, k4a, k4b);
        psi_a += h * (k1a + 2.0 * (k2a + k3a) + k4a) * (1.0 / 6.0);
        psi_b += h * (k1b + 2.0 * (k2b + k3b) + k4b) * (1.0 / 6.0);
        theta += p->omega_e * h;
        if (theta >= pi)
            theta -= two_pi;
        sine_cosine(theta, &s, &c);
        i_d = (c * psi_a + s * psi_b - p->psi_f) / p->L_d;
        i_q = (c * psi_b - s * psi_a) / p->L_q;
        u_a = p->U_dc * (2.0 * (double)da - (double)db - (double)dc) * (1.0 / 3.0);
        u_b = p->U_dc * ((double)db - (double)dc) * (1.0 / 1.73205080756887729353);
    }
}
