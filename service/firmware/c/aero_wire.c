/* Wire: see aero_wire.h. Each line does the float operations of aeroloop's protocol/wire, in the same order. */
#include "aero_wire.h"

#include <math.h>
#include <string.h>

#define SLACK 0x1p-50 /* a value this near to an edge, as a part of it, lies on the edge */
#define TIE (1.0 - SLACK)

const uint64_t aero_wire_config = AERO_CONFIG;
const aero_quantizer aero_attitude = AERO_ATTITUDE, aero_rate = AERO_RATE, aero_voltage = AERO_VOLTAGE;

/* -- quantizers -- */

static double position(const aero_quantizer *q, double y) { return (fabs(y) - q->deadzone) / q->step * TIE; }

static int uniform_index(const aero_quantizer *q, double y)
{
    double x = position(q, y);
    return x <= 0 ? 0 : x > q->top ? q->top : (int)ceil(x);
}

static int logarithmic_index(const aero_quantizer *q, double y)
{
    int low = 0, high = q->top; /* beyond all edges it is the outermost interval, too */
    while (low < high) {
        int middle = (low + high) / 2;
        if (q->edges[middle] < fabs(y) * TIE) { low = middle + 1; } else { high = middle; }
    }
    return low;
}

static int stays(const aero_quantizer *q, double y, double held) /* 0 if held is NaN */
{
    double h = q->hysteresis, outer = q->deadzone + fabs(held) * q->step, inner = outer - q->step;
    double high = fmin(q->limit, outer + h + SLACK * (outer + h));
    double low = held != 0 ? inner - h - SLACK * (inner + h) : -high;
    double along = held < 0 ? -y : y;
    return low <= along && along <= high;
}

double aero_encode(const aero_quantizer *q, double y, double held)
{
    if (isnan(y)) { return aero_no_value(q); }
    if (q->kind == AERO_CONTINUOUS) { return fabs(y) <= q->limit ? y : copysign(q->limit, y); }
    if (q->kind == AERO_HYSTERESIS && stays(q, y, held)) { return held; }
    int index = q->kind == AERO_LOGARITHMIC ? logarithmic_index(q, y) : uniform_index(q, y);
    return y > 0 ? index : -index;
}

double aero_level(const aero_quantizer *q, double code)
{
    if (q->kind == AERO_CONTINUOUS) { return code; }
    if (!(fabs(code) <= q->top)) { return NAN; }
    int i = (int)fabs(code);
    double magnitude = 0;
    if (i > 0 && q->kind == AERO_LOGARITHMIC) { magnitude = (q->edges[i - 1] + q->edges[i]) / 2; }
    else if (i > 0) { magnitude = q->deadzone + q->step / 2 + (i - 1) * q->step; }
    return code < 0 ? -magnitude : magnitude;
}

double aero_no_value(const aero_quantizer *q) { return q->kind == AERO_CONTINUOUS ? (double)NAN : -1.0 - q->top; }

int aero_saturates(const aero_quantizer *q, double y)
{
    if (q->kind == AERO_UNIFORM || q->kind == AERO_HYSTERESIS) { return position(q, y) > q->top; }
    return fabs(y) * (q->kind == AERO_CONTINUOUS ? 1 : TIE) > q->limit;
}

/* -- frames: a counter, zero bits up to the byte where a signal is continuous, codes, zero bits up to the byte -- */

typedef struct {
    size_t size;
    int gap, count, first;             /* zero bits after the counter; codes in all, and of the first signal */
    const aero_quantizer *signals[2];
} layout;

static const layout MEASUREMENT = {
    AERO_MEASUREMENT_BYTES, AERO_MEASUREMENT_GAP, AERO_MEASURED, AERO_MEASURED / 2, {&aero_attitude, &aero_rate}};
static const layout COMMAND = {
    AERO_COMMAND_BYTES, AERO_COMMAND_GAP, AERO_ACTUATORS, AERO_ACTUATORS, {&aero_voltage, NULL}};

static void put(uint8_t *frame, size_t *at, int width, uint64_t value)
{
    for (int i = width - 1; i >= 0; i--, ++*at) {
        frame[*at / 8] = (uint8_t)(frame[*at / 8] | (value >> i & 1U) << (7 - *at % 8));
    }
}

static uint64_t take(const uint8_t *frame, size_t *at, int width)
{
    uint64_t value = 0;
    for (int i = 0; i < width; i++, ++*at) { value = value << 1 | (frame[*at / 8] >> (7 - *at % 8) & 1U); }
    return value;
}

static void pack(const layout *form, uint8_t *frame, uint32_t counter, const double *codes)
{
    size_t at = 0;
    memset(frame, 0, form->size);
    put(frame, &at, AERO_COUNTER_BITS, counter);
    at += (size_t)form->gap;
    for (int i = 0; i < form->count; i++) {
        const aero_quantizer *q = form->signals[i >= form->first];
        uint64_t bits;
        if (q->kind == AERO_CONTINUOUS) { memcpy(&bits, &codes[i], sizeof bits); }
        else { bits = (uint64_t)(int64_t)codes[i]; }
        put(frame, &at, q->bits, bits);
    }
}

static int unpack(const layout *form, const uint8_t *frame, size_t size, uint32_t *counter, double *codes)
{
    double read[AERO_MAX_CODES];
    size_t at = 0;
    if (size != form->size) { return 0; }
    uint32_t found = (uint32_t)take(frame, &at, AERO_COUNTER_BITS);
    if (take(frame, &at, form->gap) != 0) { return 0; }
    for (int i = 0; i < form->count; i++) {
        const aero_quantizer *q = form->signals[i >= form->first];
        uint64_t bits = take(frame, &at, q->bits);
        if (q->kind == AERO_CONTINUOUS) { memcpy(&read[i], &bits, sizeof bits); }
        else { read[i] = (double)((int64_t)bits - ((int64_t)(bits >> (q->bits - 1)) << q->bits)); }
        if (isinf(read[i])) { return 0; }
    }
    if (take(frame, &at, (int)(8 * size - at)) != 0) { return 0; }
    *counter = found;
    memcpy(codes, read, (size_t)form->count * sizeof *codes);
    return 1;
}

int aero_unpack_measurement(const uint8_t *frame, size_t size, uint32_t *counter, double codes[AERO_MEASURED])
{
    return unpack(&MEASUREMENT, frame, size, counter, codes);
}

int aero_unpack_command(const uint8_t *frame, size_t size, uint32_t *counter, double codes[AERO_ACTUATORS])
{
    return unpack(&COMMAND, frame, size, counter, codes);
}

void aero_pack_measurement(uint8_t frame[AERO_MEASUREMENT_BYTES], uint32_t counter, const double codes[AERO_MEASURED])
{
    pack(&MEASUREMENT, frame, counter, codes);
}

void aero_pack_command(uint8_t frame[AERO_COMMAND_BYTES], uint32_t counter, const double codes[AERO_ACTUATORS])
{
    pack(&COMMAND, frame, counter, codes);
}

/* -- when frames are sent -- */

static int same(const double *codes, const double *last, int count) /* by bits, but that every NaN is alike */
{
    for (int i = 0; i < count; i++) {
        if (isnan(codes[i]) ? !isnan(last[i]) : memcmp(&codes[i], &last[i], sizeof *codes) != 0) { return 0; }
    }
    return 1;
}

int aero_due(aero_sender *sender, int on_change, int64_t k, const double *codes, int count)
{
    int64_t since = k - sender->at;
    if (!on_change) { return 1; }
    if (sender->has_codes && since < AERO_HEARTBEAT_TICKS && same(codes, sender->codes, count)) { return 0; }
    /* After missed ticks its counter may equal the last frame's: then the next tick's frame is due as well. */
    sender->has_codes = !(sender->has_sent && since % AERO_COUNTERS == 0);
    memcpy(sender->codes, codes, (size_t)count * sizeof *codes);
    sender->at = k;
    sender->has_sent = 1;
    return 1;
}

void aero_forget(aero_sender *sender) { memset(sender, 0, sizeof *sender); }
