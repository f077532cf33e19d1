/* The floor for tools.bench_core: what the frame loop does for the bundled FOG format, written straight down in C.
 * FRAME array in, CORRECTED array out, every field and count of them equal to ours (the bench compares): id, length,
 * CRC (E2E profile 1A), counter, rate and temperatures, four TS rules (equations 1, 2, 9-11), one thermal lag, validity,
 * flags and ages. No DBC, no map, one channel, one model: that is what the comparison is about. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { GAP_NS = 30000000, MAX_AGE_NS = 2000000000 };

#pragma pack(push, 1)
struct frame { int64_t t_ns; uint32_t can_id; uint8_t flags, length; uint16_t reserved; uint8_t data[64]; };
struct sample {
    int64_t t_ns, t_pub_ns; uint64_t seq; double rate_raw, rate, correction, temp;
    float sigma, age; uint32_t flags; double reference;
};
#pragma pack(pop)

struct model {
    double centers[4][2], inverse_widths[4][2], consequents[4][3];
    double temp_low, temp_high, rate_low, rate_high, tau_s, lag_scale, sigma;
};
struct state {
    double temp, coil, lagged;
    int64_t t_temp, t_rate, settled_at;
    uint64_t seq;
    int last[2], allowed[2];
    uint32_t marks;
    int64_t rejected[3], frames, ignored, samples, flag_counts[32];
};

static uint8_t table[256];

void prepare(struct state *s) {
    for (int value = 0; value < 256; value++) {
        uint8_t crc = value;
        for (int bit = 0; bit < 8; bit++) crc = crc & 0x80 ? (crc << 1) ^ 0x1D : crc << 1;
        table[value] = crc;
    }
    memset(s, 0, sizeof *s);
    s->temp = s->coil = NAN;
    s->t_rate = INT64_MIN;
    s->last[0] = s->last[1] = -1;
}

static int good(struct state *s, const struct frame *f, int kind, uint16_t data_id) {
    if (f->length != 8 || f->flags & 0x08) { s->rejected[0]++; s->marks |= 32; return 0; }
    uint8_t crc = table[table[data_id & 0xFF] ^ (data_id >> 8)];
    for (int k = 1; k < 8; k++) crc = table[crc ^ f->data[k]];
    if (crc != f->data[0]) { s->rejected[1]++; s->allowed[kind]++; s->marks |= 32; return 0; }
    int counter = f->data[1] & 15, last = s->last[kind], allowed = 1 + s->allowed[kind];
    s->last[kind] = counter;
    s->allowed[kind] = 0;
    if (last < 0) return 1;
    int step = (counter - last + 15) % 15;
    if (step == 0 || step > allowed) { s->rejected[2]++; s->marks |= 32; return 0; }
    return 1;
}

static double clip(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static void take_temperature(struct state *s, const struct model *m, const struct frame *f) {
    int16_t raw, coil;
    memcpy(&raw, f->data + 2, 2);
    memcpy(&coil, f->data + 4, 2);
    if (coil != -32768) s->coil = coil * 0.01;
    if (raw == -32768) return;
    double temp = raw * 0.01, x1 = clip(temp, m->temp_low, m->temp_high);
    if (isnan(s->temp)) {
        s->lagged = x1;
        s->settled_at = f->t_ns + (int64_t)(5e9 * m->tau_s);
    } else {
        double dt = (f->t_ns - s->t_temp) * 1e-9, x0 = clip(s->temp, m->temp_low, m->temp_high);
        double lag = (x1 - x0) / dt * m->tau_s;
        s->lagged = x1 - lag + (s->lagged - x0 + lag) * exp(-dt / m->tau_s);
    }
    s->temp = temp;
    s->t_temp = f->t_ns;
}

static double predict(const struct state *s, const struct model *m, double rate, uint32_t *flags) {
    double x[2] = {clip(s->temp, m->temp_low, m->temp_high), clip(rate, m->rate_low, m->rate_high)};
    if (x[0] != s->temp || x[1] != rate) *flags |= 4;
    double exponent[4], weights = 0, weighted = 0, shift = 0;
    for (int j = 0; j < 4; j++) {
        double a = (x[0] - m->centers[j][0]) * m->inverse_widths[j][0];
        double b = (x[1] - m->centers[j][1]) * m->inverse_widths[j][1];
        exponent[j] = -0.5 * (a * a + b * b);
    }
    do {
        weights = weighted = 0;
        for (int j = 0; j < 4; j++) {
            double w = exp(exponent[j] - shift);
            weights += w;
            weighted += w * (m->consequents[j][0] + m->consequents[j][1] * x[0] + m->consequents[j][2] * x[1]);
        }
        shift = fmax(fmax(exponent[0], exponent[1]), fmax(exponent[2], exponent[3]));
    } while (weights < 1e-250); /* far from every rule: once more, the largest exponent taken out */
    double total = weighted / weights;
    return total + (rate - total) * m->lag_scale * (s->lagged - x[0]);
}

int64_t run(struct state *s, const struct model *m, const struct frame *frames, int64_t n, struct sample *out, int64_t room) {
    int64_t written = 0;
    for (int64_t i = 0; i < n; i++) {
        const struct frame *f = frames + i;
        s->frames++;
        if (f->flags & 4) {
            s->rejected[0]++;
            s->marks |= 32;
        } else if (f->can_id == 0xA1) {
            if (good(s, f, 1, 0x0FA2)) take_temperature(s, m, f);
        } else if (f->can_id != 0xA0) {
            s->ignored++;
        } else if (good(s, f, 0, 0x0FA1)) {
            struct sample *o = out + written++ % room;
            int32_t raw;
            memcpy(&raw, f->data + 2, 4);
            double rate = raw * 1e-6, correction = 0;
            uint32_t flags = s->marks;
            s->marks = 0;
            if (s->t_rate != INT64_MIN) {
                if (f->t_ns < s->t_rate) flags |= 64;
                else if (f->t_ns - s->t_rate > GAP_NS) flags |= 1024;
            }
            s->t_rate = f->t_ns;
            if (fabs(rate) >= 400.0) flags |= 16;
            if (f->data[1] >> 4) flags |= 512;
            if (isnan(s->temp)) flags |= 1;
            else {
                if (llabs(f->t_ns - s->t_temp) > MAX_AGE_NS) flags |= 2;
                if (f->t_ns < s->settled_at) flags |= 8;
                correction = predict(s, m, rate, &flags);
            }
            *o = (struct sample){f->t_ns, 0, s->seq++, rate, rate - correction, correction, s->temp, m->sigma,
                                 isnan(s->temp) ? NAN : (f->t_ns - s->t_temp) * 1e-9, flags, NAN};
            s->samples++;
            for (; flags; flags &= flags - 1) s->flag_counts[__builtin_ctz(flags)]++;
        }
    }
    return written;
}
