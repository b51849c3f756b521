/* Replays a script of the controller: `test_golden` the golden one, compared, `test_golden SCRIPT ANSWERS` a file's.
 *
 * A script's entries are a letter and its values, little endian: `S` a state to continue from, `G` gains, `P` pieces of
 * the reference, `H` a measurement to hold, `T` a measurement to answer. An answer is the return value of
 * `aero_law_tick` as a byte, and the command; the digest follows the last one. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "aero_law.h"
#include "golden.h"

static uint64_t digest; /* of what the law has computed so far */

static void add(const double *values, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        digest = (digest ^ bits) * 0x100000001b3U;
    }
}

static FILE *script; /* NULL: the golden one */
static size_t at;

static int take(void *to, size_t size) {
    if (script != NULL) return fread(to, 1, size, script) == size;
    if (size > sizeof golden_script - at) return 0;
    memcpy(to, golden_script + at, size);
    at += size;
    return 1;
}

static int take_state(aero_law *law) {
    uint8_t has[4]; /* held codes, voltage codes, codes sent, a tick sent */
    return take(law->outputs.attitude, sizeof law->outputs.attitude) && take(&law->state, AERO_STATE_BYTES) &&
           take(has, sizeof has) && take(law->held, sizeof law->held) &&
           take(law->voltage_codes, sizeof law->voltage_codes) &&
           take(law->sender.codes, AERO_ACTUATORS * sizeof(double)) && take(&law->sender.at, sizeof law->sender.at) &&
           (law->has_held = has[0], law->sender.has_codes = has[2], law->sender.has_sent = has[3], 1);
}

static int take_pieces(aero_law *law) {
    static aero_piece *pieces;
    uint32_t count;
    if (!take(&count, sizeof count)) return 0;
    pieces = realloc(pieces, count * sizeof *pieces);
    law->pieces = pieces;
    law->piece_count = count;
    return pieces != NULL && take(pieces, count * sizeof *pieces);
}

int main(int argc, char **argv) {
    static aero_law law;
    FILE *answers = NULL;
    uint8_t kind, size, frame[256], command[AERO_COMMAND_BYTES];
    unsigned long ticks = 0, differ = 0, place = 0;
    if (argc == 3) {
        script = fopen(argv[1], "rb");
        answers = fopen(argv[2], "wb");
        if (script == NULL || answers == NULL) return 2;
    }
    aero_law_start(&law);
    while (take(&kind, 1)) {
        int64_t k = 0;
        int good = kind == 'S'   ? take_state(&law)
                   : kind == 'G' ? take(&law.gains, AERO_GAINS_BYTES)
                   : kind == 'P' ? take_pieces(&law)
                                 : (kind == 'H' || take(&k, sizeof k)) && take(&size, 1) && take(frame, size);
        if (!good) return 2;
        if (kind == 'H') (void)aero_law_hold(&law, frame, size);
        if (kind != 'T') continue;
        int length = aero_law_tick(&law, frame, size, k, command);
        size_t bytes = length > 0 ? (size_t)length : 0;
        uint8_t said = (uint8_t)length;
        ticks++;
        add(law.outputs.voltages, AERO_ACTUATORS);
        add((const double *)&law.state, AERO_STATE_BYTES / sizeof(double));
        if (answers != NULL) {
            if (fwrite(&said, 1, 1, answers) != 1 || fwrite(command, 1, bytes, answers) != bytes) return 2;
        } else {
            differ += said != golden_answers[place] || memcmp(golden_answers + place + 1, command, bytes) != 0;
            place += 1 + (golden_answers[place] == 255 ? 0U : golden_answers[place]);
        }
    }
    if (answers != NULL) return fwrite(&digest, sizeof digest, 1, answers) == 1 && fclose(answers) == 0 ? 0 : 2;
    printf("%lu of %lu commands differ; the voltages before quantization %s\n", differ, ticks,
           digest == golden_digest ? "are the same to the last bit" : "differ");
    return differ == 0 && ticks > 0 && digest == golden_digest ? 0 : 1;
}
