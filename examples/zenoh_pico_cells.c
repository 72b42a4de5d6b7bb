/* A microcontroller that sends the frames of a hand to blindgrasp over Zenoh, with zenoh-pico 1.x.
 *
 *   tactile_source:
 *     params: {driver: zenoh, hand: hands/parallel-gripper.yaml, listen: tcp/192.168.1.10:7447, key: hand/frames}
 *
 * Build it with zenoh-pico for your board, or on Linux:  cc zenoh_pico_cells.c -lzenohpico -o cells && ./cells tcp/127.0.0.1:7447
 * Put your hand's readings into read_hand(). This one has no hand: it sends an open gripper that feels nothing. */

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include <zenoh-pico.h>

#define N_JOINTS 1
#define N_CELLS 24
#define KEY "hand/frames"
#define PERIOD_MS 10

/* A frame: joints in radians (metres if they slide) and cells in newtons, in the order of the pad layout. */
struct frame {
    double joints[N_JOINTS];
    double cells[N_CELLS];
    const char *phase; /* "open", "closing" or "settled" */
};

/* The next readings; false if the hand did not answer. Send nothing then: blindgrasp sees the gap and holds. */
static bool read_hand(struct frame *frame) {
    frame->phase = "open";
    frame->joints[0] = 0.0425;
    for (int i = 0; i < N_CELLS; i++) frame->cells[i] = 0.0;
    return true;
}

/* Appends a list of numbers; the length, or -1 if there is no room. */
static int list(char *to, int size, int length, const char *name, const double *numbers, int n) {
    length += snprintf(to + length, size - length, ",\"%s\":[", name);
    for (int i = 0; i < n && length < size; i++) {
        length += snprintf(to + length, size - length, i ? ",%.4f" : "%.4f", numbers[i]);
    }
    if (length < size) length += snprintf(to + length, size - length, "]");
    return length < size ? length : -1;
}

/* The line protocol: one JSON object. The numbers begin at 0 and leave out no frame that was read. */
static bool write_frame(char *to, int size, uint32_t seq, const struct frame *frame) {
    int length = snprintf(to, size, "{\"seq\":%lu,\"phase\":\"%s\"", (unsigned long)seq, frame->phase);
    length = list(to, size, length, "joints", frame->joints, N_JOINTS);
    if (length < 0) return false;
    length = list(to, size, length, "cells_newtons", frame->cells, N_CELLS);
    if (length < 0 || length + 2 > size) return false;
    to[length] = '}';
    to[length + 1] = 0;
    return true;
}

int main(int argc, char **argv) {
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, argc > 1 ? argv[1] : "tcp/192.168.1.10:7447");
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) {
        fprintf(stderr, "no answer from tactile_source\n");
        return 1;
    }
    z_view_keyexpr_t key;
    z_owned_publisher_t publisher;
    if (z_view_keyexpr_from_str(&key, KEY) < 0 ||
        z_declare_publisher(z_loan(session), &publisher, z_loan(key), NULL) < 0) {
        return 1;
    }
    static char text[32 * (N_JOINTS + N_CELLS) + 128];
    struct frame frame;
    for (uint32_t seq = 0;; seq++) {
        z_sleep_ms(PERIOD_MS);
        if (!read_hand(&frame)) continue;
        if (!write_frame(text, sizeof text, seq, &frame)) return 1;
        z_owned_bytes_t payload;
        z_bytes_copy_from_str(&payload, text);
        if (z_publisher_put(z_loan(publisher), z_move(payload), NULL) < 0) break;
    }
    z_drop(z_move(publisher));
    z_drop(z_move(session));
    return 1;
}
