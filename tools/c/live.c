/* The floor for tools.bench_live: batch receive, decode and evaluation of the FOG formats on a CAN interface, written
 * straight down in C. Does what `rtcomp run` does up to the corrected sample, and nothing else: poll, recvmmsg with
 * time stamps and drop counts, a look at both clocks for steps, checks, evaluation (core.c), a ring of samples.
 * Use: live INTERFACE classic|fd MODEL; ends when standard input does, prints one JSON line. */
#define _GNU_SOURCE
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "core.c"

enum { BATCH = 256, RING = 1 << 16, ROOM = 1 << 20 };
static struct mmsghdr headers[BATCH];
static struct iovec vectors[BATCH];
static struct canfd_frame raw[BATCH];
static char control[BATCH][128] __attribute__((aligned(8)));
static struct frame frames[BATCH];
static struct sample ring[RING];
static int32_t latency_ns[ROOM];
static int64_t offset_ns, steps, lost, last_ns;
static uint32_t drops;

static int64_t read_clock(clockid_t which) {
    struct timespec t;
    clock_gettime(which, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static uint16_t crc16(const uint8_t *data, int length, uint16_t crc) {
    static uint16_t words[256];
    if (!words[1])
        for (int value = 0; value < 256; value++) {
            uint16_t word = value << 8;
            for (int bit = 0; bit < 8; bit++) word = word & 0x8000 ? (word << 1) ^ 0x1021 : word << 1;
            words[value] = word;
        }
    for (int k = 0; k < length; k++) crc = crc << 8 ^ words[crc >> 8 ^ data[k]];
    return crc;
}

/* FOG_FD: E2E profile 5, rate and temperature in one frame. */
static int64_t run_fd(struct state *s, const struct model *m, const struct frame *f, int64_t n, struct sample *out) {
    int64_t written = 0;
    static const uint8_t data_id[2] = {0xA3, 0x0F};
    for (; n--; f++) {
        uint16_t sent;
        int32_t rate_raw;
        if (f->can_id != 0xA2 || f->length != 12 || f->flags & 0x0C) continue;
        memcpy(&sent, f->data, 2);
        if (sent != crc16(data_id, 2, crc16(f->data + 2, 10, 0xFFFF))) { s->rejected[1]++; continue; }
        int last = s->last[0], step = (uint8_t)(f->data[2] - last);
        s->last[0] = f->data[2];
        if (last >= 0 && step != 1) { s->rejected[2]++; continue; }
        struct frame temperature = *f;
        memcpy(temperature.data + 2, f->data + 8, 2);
        take_temperature(s, m, &temperature);
        memcpy(&rate_raw, f->data + 4, 4);
        uint32_t flags = f->t_ns < s->settled_at ? 8 : 0;
        double rate = rate_raw * 1e-6, correction = predict(s, m, rate, &flags);
        out[written++] = (struct sample){f->t_ns, 0, s->seq++, rate, rate - correction, correction, s->temp, m->sigma,
                                         (f->t_ns - s->t_temp) * 1e-9, flags, NAN};
    }
    return written;
}

static void take_control(struct msghdr *h, struct frame *f, int64_t now) {
    f->t_ns = now;
    for (struct cmsghdr *c = CMSG_FIRSTHDR(h); c; c = CMSG_NXTHDR(h, c)) {
        if (c->cmsg_type == SO_TIMESTAMPNS) {
            struct timespec t;
            memcpy(&t, CMSG_DATA(c), sizeof t);
            f->t_ns = t.tv_sec * 1000000000LL + t.tv_nsec;
        } else if (c->cmsg_type == SO_RXQ_OVFL) {
            uint32_t count;
            memcpy(&count, CMSG_DATA(c), 4);
            lost += count - drops;
            drops = count;
        }
    }
    if (f->t_ns > now) f->t_ns = now;
    if (f->t_ns < last_ns) f->t_ns = last_ns;
    last_ns = f->t_ns;
}

static int take_batch(int descriptor) {
    for (int k = 0; k < BATCH; k++) headers[k].msg_hdr.msg_controllen = sizeof control[k];
    int count = recvmmsg(descriptor, headers, BATCH, MSG_DONTWAIT, NULL);
    int64_t host = read_clock(CLOCK_REALTIME), now = read_clock(CLOCK_MONOTONIC) + offset_ns;
    if (llabs(host - now) > 2000000) steps++;
    for (int k = 0; k < count; k++) {
        const struct canfd_frame *r = raw + k;
        struct frame *f = frames + k;
        take_control(&headers[k].msg_hdr, f, now);
        f->can_id = r->can_id & CAN_EFF_MASK;
        f->flags = (r->can_id & CAN_EFF_FLAG ? 1 : 0) | (headers[k].msg_len == CANFD_MTU ? 2 : 0)
                   | (r->can_id & CAN_ERR_FLAG ? 4 : 0) | (r->can_id & CAN_RTR_FLAG ? 8 : 0);
        f->length = r->len;
        memcpy(f->data, r->data, 64);
    }
    return count;
}

static int open_bus(const char *name, int fd_frames) {
    struct can_filter classic[2] = {{0xA0, CAN_SFF_MASK | CAN_EFF_FLAG, }, {0xA1, CAN_SFF_MASK | CAN_EFF_FLAG}};
    struct can_filter flexible = {0xA2, CAN_SFF_MASK | CAN_EFF_FLAG};
    int s = socket(PF_CAN, SOCK_RAW, CAN_RAW), on = 1, size = 8 << 20;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex(name)};
    setsockopt(s, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on);
    setsockopt(s, SOL_CAN_RAW, CAN_RAW_FILTER, fd_frames ? &flexible : classic, fd_frames ? sizeof flexible : sizeof classic);
    setsockopt(s, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size);
    setsockopt(s, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    setsockopt(s, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on);
    if (bind(s, (struct sockaddr *)&address, sizeof address)) { perror(name); exit(1); }
    return s;
}

static int ascending(const void *a, const void *b) { return *(const int32_t *)a - *(const int32_t *)b; }

int main(int argc, char **argv) {
    struct state state;
    struct model model;
    FILE *file = argc == 4 ? fopen(argv[3], "rb") : NULL;
    if (!file || fread(&model, sizeof model, 1, file) != 1) { fprintf(stderr, "use: live INTERFACE classic|fd MODEL\n"); return 2; }
    int flexible = !strcmp(argv[2], "fd"), bus = open_bus(argv[1], flexible);
    for (int k = 0; k < BATCH; k++) {
        vectors[k] = (struct iovec){raw + k, sizeof raw[k]};
        headers[k].msg_hdr = (struct msghdr){.msg_iov = vectors + k, .msg_iovlen = 1, .msg_control = control[k]};
    }
    prepare(&state);
    offset_ns = read_clock(CLOCK_REALTIME) - read_clock(CLOCK_MONOTONIC);
    struct pollfd polled[2] = {{bus, POLLIN, 0}, {0, POLLIN, 0}};
    int64_t received = 0, samples = 0, cpu = read_clock(CLOCK_THREAD_CPUTIME_ID);
    printf("ready\n");
    fflush(stdout);
    while (poll(polled, 2, 200) >= 0 && !(polled[1].revents && !polled[0].revents)) {
        if (!polled[0].revents) continue;
        int count = take_batch(bus);
        if (count <= 0) continue;
        received += count;
        static struct sample out[BATCH];
        int64_t n = flexible ? run_fd(&state, &model, frames, count, out) : run(&state, &model, frames, count, out, BATCH);
        int64_t now = read_clock(CLOCK_MONOTONIC) + offset_ns;
        for (int64_t k = 0; k < n; k++, samples++) {
            ring[samples % RING] = out[k];
            latency_ns[samples % ROOM] = now - out[k].t_ns;
        }
    }
    cpu = read_clock(CLOCK_THREAD_CPUTIME_ID) - cpu;
    int64_t kept = samples < ROOM ? samples : ROOM;
    qsort(latency_ns, kept, sizeof *latency_ns, ascending);
    printf("{\"frames\": %lld, \"samples\": %lld, \"lost\": %lld, \"cpu_s\": %.9f, \"p50_us\": %.3f, \"p99_us\": %.3f}\n",
           (long long)received, (long long)samples, (long long)lost, cpu * 1e-9,
           kept ? latency_ns[kept / 2] / 1e3 : 0.0, kept ? latency_ns[kept * 99 / 100] / 1e3 : 0.0);
    return 0;
}
