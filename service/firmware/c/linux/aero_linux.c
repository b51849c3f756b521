/* Node on Linux with the emulated plant behind it: the port on SocketCAN or python-can's udp_multicast.
 *
 *     aero_node socketcan CHANNEL | aero_node udp_multicast GROUP PORT HOP_LIMIT
 *
 * It ends at 0 V on SIGTERM, SIGINT, or when the other end of a pipe at its stdin is closed. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "aero_node.h"
#include "aero_plant.h"
#include "aero_port.h"

static const int64_t SECOND_NS = 1000000000, ANSWER_TIMEOUT_NS = 2000000000; /* in lockstep the watchdog stands still */
static const int IDLE_WAIT_MS = 20;
static const int MOST_REFUSED = 64; /* of a call: what comes after so many that are no frames waits for the next */

static volatile sig_atomic_t stopped;
static int bus, on_udp;
static struct sockaddr_in group;

/* -- the plant: a step and a sample of its sensors each period -- */

static aero_plant plant;
static int64_t plant_tick;

static void advance_to(int64_t k)
{
    for (; plant_tick < k; plant_tick++) { aero_plant_step(&plant); }
}

void aero_port_actuate(int64_t k, const double voltages[AERO_ACTUATORS])
{
    advance_to(k);
    memcpy(plant.voltages, voltages, sizeof plant.voltages);
}

void aero_port_enable(int on) { (void)on; } /* the emulated plant has no power stage */

void aero_port_measure(int64_t k, double q[4], double w[3])
{
    advance_to(k);
    memcpy(q, plant.attitude, sizeof plant.attitude);
    memcpy(w, plant.rate, sizeof plant.rate);
}

/* -- clock and bus -- */

int64_t aero_port_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * SECOND_NS + now.tv_nsec;
}

static void open_udp(const char *address, const char *port, const char *hops)
{
    int yes = 1, ttl = atoi(hops);
    struct sockaddr_in any = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
    struct ip_mreq request = {.imr_multiaddr.s_addr = inet_addr(address)};
    bus = socket(AF_INET, SOCK_DGRAM, 0);
    group = any;
    group.sin_addr = request.imr_multiaddr;
    if (setsockopt(bus, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) ||
        setsockopt(bus, SOL_SOCKET, SO_REUSEPORT, &yes, sizeof yes) ||
        setsockopt(bus, IPPROTO_IP, IP_MULTICAST_TTL, &ttl, sizeof ttl) ||
        bind(bus, (struct sockaddr *)&any, sizeof any) ||
        setsockopt(bus, IPPROTO_IP, IP_ADD_MEMBERSHIP, &request, sizeof request)) { bus = -1; }
}

static void open_can(const char *channel)
{
    int fd_frames = AERO_CAN_FD;
    struct sockaddr_can name = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(channel)};
    bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &fd_frames, sizeof fd_frames) || name.can_ifindex == 0 ||
        bind(bus, (struct sockaddr *)&name, sizeof name)) { bus = -1; }
}

/* A datagram of udp_multicast is a msgpack dictionary of the fields of python-can's Message. */
void aero_port_send(uint32_t id, const uint8_t *data, size_t size)
{
    int is_fd = size > CAN_MAX_DLEN;
    if (on_udp) {
        uint8_t out[65 + CANFD_MAX_DLEN] = "\x85\xae" "arbitration_id\xcd__\xae" "is_extended_id\xc2\xa5" "is_fd_\xae"
                                           "bitrate_switch_\xa4" "data\xc4_";
        out[17] = (uint8_t)(id >> 8);
        out[18] = (uint8_t)id;
        out[41] = out[57] = is_fd ? 0xc3 : 0xc2;
        out[64] = (uint8_t)size;
        memcpy(out + 65, data, size);
        sendto(bus, out, 65 + size, MSG_DONTWAIT, (struct sockaddr *)&group, sizeof group);
        return;
    }
    struct canfd_frame frame = {.can_id = id, .len = (uint8_t)size, .flags = is_fd ? CANFD_BRS : 0};
    memcpy(frame.data, data, size);
    send(bus, &frame, is_fd ? CANFD_MTU : CAN_MTU, MSG_DONTWAIT);
}

/* The value of a key, which has some bytes; NULL if there is none. In python-can's dictionaries identifier and flags
 * precede the data, so the first key of a name is its own. */
static const uint8_t *value_of(const char *key, size_t bytes, const uint8_t *datagram, size_t size)
{
    const uint8_t *found = memmem(datagram, size, key, strlen(key));
    return found && found + strlen(key) + bytes <= datagram + size ? found + strlen(key) : NULL;
}

static int read_datagram(const uint8_t *datagram, size_t got, uint32_t *id, uint8_t *data, size_t *size)
{
    static const char *const refused[] = {"extended_id\xc3", "remote_frame\xc3", "error_frame\xc3", "is_fd\xc3"};
    const uint8_t *number = value_of("arbitration_id\xcd", 2, datagram, got);
    const uint8_t *bytes = value_of("data\xc4", 1, datagram, got);
    if (!number || !bytes || *bytes > CANFD_MAX_DLEN || bytes + 1 + *bytes > datagram + got) { return 0; }
    for (int i = 0; i < 3 + !AERO_CAN_FD; i++) {
        if (value_of(refused[i], 0, datagram, got)) { return 0; }
    }
    *id = (uint32_t)(number[0] << 8 | number[1]);
    memcpy(data, bytes + 1, *size = *bytes);
    return 1;
}

int aero_port_receive(uint32_t *id, uint8_t data[64], size_t *size)
{
    uint8_t datagram[4096];
    struct canfd_frame frame;
    ssize_t got;
    for (int i = 0; on_udp && i < MOST_REFUSED; i++) {
        got = recv(bus, datagram, sizeof datagram, MSG_DONTWAIT);
        if (got < 0) { return 0; }
        if (read_datagram(datagram, (size_t)got, id, data, size)) { return 1; }
    }
    for (int i = 0; !on_udp && i < MOST_REFUSED; i++) {
        got = recv(bus, &frame, sizeof frame, MSG_DONTWAIT);
        if (got < (ssize_t)CAN_MTU) { return 0; }
        if (frame.can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG) || frame.len > CANFD_MAX_DLEN) { continue; }
        *id = frame.can_id;
        memcpy(data, frame.data, *size = frame.len);
        return 1;
    }
    return 0;
}

/* -- the loop -- */

static void stop(int signal_number) { stopped = signal_number; }

/* Wait for a frame, at most so long; notice that the parent process has ended. */
static void wait_for_frame(int milliseconds)
{
    struct pollfd files[] = {{.fd = bus, .events = POLLIN}, {.fd = STDIN_FILENO}};
    poll(files, 2, milliseconds);
    if (files[1].revents & POLLHUP) { stopped = SIGHUP; }
}

static void run_in_real_time(aero_node *node)
{
    int64_t start = aero_port_now();
    for (int64_t k = 0; !stopped; k++) {
        int64_t late = aero_port_now() - start - k * AERO_PERIOD_NS;
        if (late >= AERO_PERIOD_NS) { k += (late + AERO_PERIOD_NS - 1) / AERO_PERIOD_NS; } /* the next one ahead */
        int64_t due = start + k * AERO_PERIOD_NS;
        struct timespec until = {.tv_sec = due / SECOND_NS, .tv_nsec = due % SECOND_NS};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR && !stopped) { }
        if (stopped) { return; }
        wait_for_frame(0);
        aero_poll(node);
        aero_tick(node, k);
    }
}

static void run_in_lockstep(aero_node *node)
{
    while (!stopped) {
        aero_poll(node);
        if (!aero_in_session(node)) { wait_for_frame(IDLE_WAIT_MS); continue; }
        aero_tick(node, node->ticked + 1);
        int64_t deadline = aero_port_now() + ANSWER_TIMEOUT_NS;
        while (!stopped && aero_in_session(node) && node->measured && !aero_answered(node)) {
            wait_for_frame(IDLE_WAIT_MS);
            aero_poll(node);
            if (aero_port_now() > deadline) { aero_trip(node, AERO_NO_ANSWER); }
        }
    }
}

int main(int count, char **words)
{
    static aero_node node;
    struct sigaction action = {.sa_handler = stop};
    on_udp = count == 5 && strcmp(words[1], "udp_multicast") == 0;
    if (on_udp) { open_udp(words[2], words[3], words[4]); }
    else if (count == 3 && strcmp(words[1], "socketcan") == 0) { open_can(words[2]); }
    else { bus = -1; errno = EINVAL; }
    if (bus < 0) { perror("cannot open the CAN bus"); return 2; }
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    sigprocmask(SIG_SETMASK, &action.sa_mask, NULL); /* a parent may have blocked them */
    aero_plant_start(&plant);
    aero_start(&node);
    if (AERO_LOCKSTEP) { run_in_lockstep(&node); } else { run_in_real_time(&node); }
    aero_leave(&node);
    return 0;
}
