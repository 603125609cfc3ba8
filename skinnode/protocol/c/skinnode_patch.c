/* Written by skinnode eds --c. MIT licence. See skinnode_patch.h. */
#include "skinnode_patch.h"

#include <string.h>

/* C99 has no static assertions; an array of negative size does not compile. */
#define SKN_REQUIRE(name, condition) typedef char skn_require_##name[(condition) ? 1 : -1]

SKN_REQUIRE(code_bits, (SKN_CODE_BITS == 16) || (SKN_CODE_BITS == 24));
SKN_REQUIRE(sizes, (SKN_ROWS >= 1) && (SKN_ROWS <= 254) && (SKN_COLUMNS >= 1) && (SKN_COLUMNS <= 254));
SKN_REQUIRE(chunks, (SKN_CHUNKS >= 1) && (SKN_CHUNKS <= (SKN_FD ? 0xFFFF : 256)));
SKN_REQUIRE(chunk, (SKN_CODES_PER_CHUNK * SKN_CODE_BYTES) <= SKN_BODY_BYTES);
/* skn_round_ratio computes with products of up to (2 * SPAN + 1) * 2^35 * 2^24. */
SKN_REQUIRE(scale, (SKN_CODE_SCALE_ONE >= 1) && (SKN_CODE_SCALE_ONE <= 8) && (SKN_CODE_SCALE_LO <= 7) &&
                       ((4 * SKN_CODE_SCALE_LO) >= SKN_CODE_SCALE_ONE) && (SKN_CODE_SCALE_SPAN >= 1) &&
                       (SKN_CODE_SCALE_SPAN <= 7));

/* --- sets of chunks */

static bool skn_has(const uint8_t *set, uint16_t chunk)
{
    return ((uint32_t)set[chunk / 8u] & (1u << (chunk % 8u))) != 0u;
}

static void skn_add(uint8_t *set, uint16_t chunk)
{
    set[chunk / 8u] = (uint8_t)(set[chunk / 8u] | (1u << (chunk % 8u)));
}

/* --- layout of the chunks */

/* Return the number of the first code of a chunk, and write how many codes it has. */
static uint16_t skn_codes_of(uint16_t chunk, uint16_t *count)
{
    const uint32_t per_line = SKN_CODES / SKN_LINES;
    const uint32_t line = (uint32_t)chunk / SKN_CHUNKS_PER_LINE;
    const uint32_t within = ((uint32_t)chunk % SKN_CHUNKS_PER_LINE) * SKN_CODES_PER_CHUNK;
    const uint32_t left = per_line - within;

    *count = (uint16_t)((left < SKN_CODES_PER_CHUNK) ? left : SKN_CODES_PER_CHUNK);
    return (uint16_t)((line * per_line) + within);
}

static void skn_put_code(uint8_t *bytes, uint32_t code)
{
    bytes[0] = (uint8_t)(code & 0xFFu);
    bytes[1] = (uint8_t)((code >> 8) & 0xFFu);
#if SKN_CODE_BITS == 24
    bytes[2] = (uint8_t)((code >> 16) & 0xFFu);
#endif
}

static uint32_t skn_get_code(const uint8_t *bytes)
{
    uint32_t code = (uint32_t)bytes[0] | ((uint32_t)bytes[1] << 8);

#if SKN_CODE_BITS == 24
    code |= (uint32_t)bytes[2] << 16;
#endif
    return code;
}

static void skn_put_u16(uint8_t *bytes, uint16_t value)
{
    bytes[0] = (uint8_t)(value & 0xFFu);
    bytes[1] = (uint8_t)(value >> 8);
}

static uint16_t skn_get_u16(const uint8_t *bytes)
{
    return (uint16_t)((uint32_t)bytes[0] | ((uint32_t)bytes[1] << 8));
}

/* --- scan check */

/* Extend a CRC with polynomial 0x1021 over one byte, without a table. */
static uint16_t skn_crc_byte(uint16_t crc, uint8_t byte)
{
    uint32_t value = (((uint32_t)crc << 8) | ((uint32_t)crc >> 8)) & 0xFFFFu;

    value ^= byte;
    value ^= (value & 0xFFu) >> 4;
    value ^= (value << 12) & 0xFFFFu;
    value ^= (value & 0xFFu) << 5;
    return (uint16_t)value;
}

SKN_API uint16_t skn_crc16(uint16_t crc, const uint8_t *data, size_t length)
{
    uint16_t extended = crc;

    for (size_t at = 0; at < length; at++) {
        extended = skn_crc_byte(extended, data[at]);
    }
    return extended;
}

static uint16_t skn_check_of_codes(const skn_code_t *codes)
{
    uint16_t crc = SKN_CRC_INITIAL;

    for (size_t at = 0; at < SKN_CODES; at++) {
        uint8_t bytes[SKN_CODE_BYTES];

        skn_put_code(bytes, codes[at]);
        crc = skn_crc16(crc, bytes, SKN_CODE_BYTES);
    }
    return crc;
}

/* ======================================================================================================== */
/* Board: codes                                                                                             */
/* ======================================================================================================== */

#define SKN_REAL32_BIAS 127u
#define SKN_REAL32_FRACTION_BITS 23u
#define SKN_REAL32_HIDDEN (UINT32_C(1) << SKN_REAL32_FRACTION_BITS)

SKN_API uint32_t skn_real32(uint64_t value, uint8_t fraction_bits)
{
    uint32_t highest = 0;
    uint64_t fraction;

    if (value == 0u) {
        return 0;
    }
    while ((value >> highest) > 1u) {
        highest++;
    }
    if (highest <= SKN_REAL32_FRACTION_BITS) {
        fraction = value << (SKN_REAL32_FRACTION_BITS - highest);
    } else {
        const uint32_t cut = highest - SKN_REAL32_FRACTION_BITS;
        const uint64_t half = UINT64_C(1) << (cut - 1u);
        const uint64_t rest = value & ((half << 1) - 1u);

        fraction = value >> cut;
        if ((rest > half) || ((rest == half) && ((fraction & 1u) != 0u))) {
            fraction++; /* may carry into the exponent, which is then also correct */
        }
    }
    return (((highest + SKN_REAL32_BIAS) - fraction_bits) << SKN_REAL32_FRACTION_BITS) +
           (uint32_t)(fraction - SKN_REAL32_HIDDEN);
}

/* Return the code of R/R0 = above / below, for above < 2^60 and 0 < below < 2^35. */
static skn_code_t skn_round_ratio(uint64_t above, uint64_t below)
{
    const uint64_t scaled = SKN_CODE_SCALE_ONE * above;
    const uint64_t lowest = SKN_CODE_SCALE_LO * below;
    const uint64_t span = SKN_CODE_SCALE_SPAN * below;
    uint64_t code;
    uint64_t rest;

    if (scaled < lowest) { /* in range down to half a step below code 0 */
        return (skn_code_t)(((2u * (lowest - scaled) * SKN_CODE_STEPS) <= span) ? 0u : SKN_CODE_OVER_RANGE);
    }
    if ((scaled - lowest) > (2u * span)) {
        return (skn_code_t)SKN_CODE_OVER_RANGE;
    }
    code = ((scaled - lowest) * SKN_CODE_STEPS) / span;
    rest = ((scaled - lowest) * SKN_CODE_STEPS) - (code * span);
    if (((2u * rest) > span) || (((2u * rest) == span) && ((code & 1u) != 0u))) {
        code++;
    }
    return (skn_code_t)((code <= SKN_CODE_STEPS) ? code : SKN_CODE_OVER_RANGE);
}

SKN_API skn_code_t skn_encode(uint32_t resistance, uint8_t fraction_bits, uint32_t baseline)
{
    const uint32_t exponent = baseline >> SKN_REAL32_FRACTION_BITS; /* with the sign above it */
    const uint64_t mantissa = (baseline & (SKN_REAL32_HIDDEN - 1u)) | SKN_REAL32_HIDDEN;
    /* R/R0 = resistance * 2^shift / mantissa */
    const int32_t bias = (int32_t)SKN_REAL32_BIAS + (int32_t)SKN_REAL32_FRACTION_BITS;
    const int32_t shift = (bias - (int32_t)exponent) - (int32_t)fraction_bits;
    uint32_t code;

    if (resistance == SKN_OPEN_CIRCUIT) {
        code = SKN_CODE_OPEN;
    } else if (resistance == SKN_SHORT_CIRCUIT) {
        code = SKN_CODE_SHORT;
    } else if ((exponent == 0u) || (exponent >= 255u)) { /* no baseline: not positive, tiny, or not finite */
        code = SKN_CODE_OVER_RANGE;
    } else if ((shift >= 0) && (shift <= 27)) { /* for larger shifts, R/R0 is at least 16 */
        code = skn_round_ratio((uint64_t)resistance << (uint32_t)shift, mantissa);
    } else if ((shift < 0) && (shift >= -11)) { /* for smaller shifts, R/R0 is less than 1/8 */
        code = skn_round_ratio(resistance, mantissa << (uint32_t)(-shift));
    } else {
        code = SKN_CODE_OVER_RANGE;
    }
    return (skn_code_t)code;
}

SKN_API skn_code_t skn_encode_ratio(uint32_t resistance, uint32_t baseline)
{
    uint32_t code;

    if (resistance == SKN_OPEN_CIRCUIT) {
        code = SKN_CODE_OPEN;
    } else if (resistance == SKN_SHORT_CIRCUIT) {
        code = SKN_CODE_SHORT;
    } else if (baseline != 0u) {
        code = skn_round_ratio(resistance, baseline);
    } else {
        code = SKN_CODE_OVER_RANGE;
    }
    return (skn_code_t)code;
}

SKN_API uint32_t skn_divider(uint32_t reference, uint32_t reading, uint32_t full_scale)
{
    uint64_t resistance;

    if (reading == 0u) {
        return SKN_OPEN_CIRCUIT;
    }
    if (reading >= full_scale) {
        return SKN_SHORT_CIRCUIT;
    }
    resistance = (uint64_t)reference * ((uint64_t)full_scale - reading);
    resistance = (resistance + ((uint64_t)reading / 2u)) / reading;
    return (resistance < SKN_OPEN_CIRCUIT) ? (uint32_t)resistance : (SKN_OPEN_CIRCUIT - 1u);
}

SKN_API bool skn_find_wire_faults(const skn_code_t *codes, skn_wire_faults_t *faults)
{
    bool any = false;

    (void)memset(faults, 0xFF, sizeof *faults);
    for (uint32_t row = 0; row < SKN_ROWS; row++) { /* clear the bits that a crossing contradicts */
        for (uint32_t column = 0; column < SKN_COLUMNS; column++) {
            const uint32_t code = codes[(row * SKN_COLUMNS) + column];
            const uint32_t upper = UINT32_C(1) << (row % 32u);
            const uint32_t lower = UINT32_C(1) << (column % 32u);

            if (code != SKN_CODE_OPEN) {
                faults->upper[2u * (row / 32u)] &= ~upper;
                faults->lower[2u * (column / 32u)] &= ~lower;
            }
            if (code != SKN_CODE_SHORT) {
                faults->upper[(2u * (row / 32u)) + 1u] &= ~upper;
                faults->lower[(2u * (column / 32u)) + 1u] &= ~lower;
            }
        }
    }
#if (SKN_ROWS % 32) != 0 /* bits of wires that the patch does not have */
    faults->upper[SKN_FAULT_WORDS(SKN_ROWS) - 2u] &= (UINT32_C(1) << (SKN_ROWS % 32u)) - 1u;
    faults->upper[SKN_FAULT_WORDS(SKN_ROWS) - 1u] &= (UINT32_C(1) << (SKN_ROWS % 32u)) - 1u;
#endif
#if (SKN_COLUMNS % 32) != 0
    faults->lower[SKN_FAULT_WORDS(SKN_COLUMNS) - 2u] &= (UINT32_C(1) << (SKN_COLUMNS % 32u)) - 1u;
    faults->lower[SKN_FAULT_WORDS(SKN_COLUMNS) - 1u] &= (UINT32_C(1) << (SKN_COLUMNS % 32u)) - 1u;
#endif
    for (size_t at = 0; at < SKN_FAULT_WORDS(SKN_ROWS); at++) {
        any = any || (faults->upper[at] != 0u);
    }
    for (size_t at = 0; at < SKN_FAULT_WORDS(SKN_COLUMNS); at++) {
        any = any || (faults->lower[at] != 0u);
    }
    return any;
}

/* ======================================================================================================== */
/* Board: scans                                                                                             */
/* ======================================================================================================== */

SKN_API void skn_sender_init(skn_sender_t *sender)
{
    (void)memset(sender, 0, sizeof *sender);
    sender->policy.threshold = SKN_DEFAULT_THRESHOLD;
    sender->policy.refresh = SKN_DEFAULT_REFRESH;
    sender->full_due = true;
    for (size_t at = 0; at < SKN_CODES; at++) {
        sender->sent[at] = (skn_code_t)SKN_CODE_OPEN;
    }
}

SKN_API void skn_sender_full(skn_sender_t *sender)
{
    sender->full_due = true;
}

SKN_API void skn_sender_baseline_changed(skn_sender_t *sender)
{
    sender->baseline_changed = true;
    sender->full_due = true;
}

SKN_API void skn_sender_conversions(skn_sender_t *sender, uint32_t conversions)
{
    if ((!sender->counted) || (conversions != sender->conversions)) {
        sender->phase = (uint8_t)((sender->phase % SKN_PHASES) + 1u);
    }
    sender->counted = true;
    sender->conversions = conversions;
}

/* Return whether a code must be sent, given the code that the receiver has. */
static bool skn_has_changed(uint32_t code, uint32_t sent, uint16_t threshold)
{
    const uint32_t change = (code > sent) ? (code - sent) : (sent - code);
    const bool reserved = (code > SKN_CODE_STEPS) || (sent > SKN_CODE_STEPS);

    return (change > threshold) || (reserved && (change != 0u));
}

/* Add a chunk to the scan, and record its codes as sent. */
static void skn_take_chunk(skn_sender_t *sender, const skn_code_t *codes, uint16_t chunk, uint16_t first,
                           uint16_t count)
{
    skn_add(sender->due, chunk);
    sender->chunks_due++;
    (void)memcpy(&sender->sent[first], &codes[first], count * sizeof codes[0]);
}

static bool skn_is_full_scan(skn_sender_t *sender)
{
    const skn_policy_t *policy = &sender->policy;

    if (policy->mode != SKN_MODE_CHANGED) {
        return true;
    }
    if (sender->since_full < UINT16_MAX) {
        sender->since_full++;
    }
    if ((!sender->full_due) && ((policy->refresh == 0u) || (sender->since_full < policy->refresh))) {
        return false;
    }
    sender->full_due = false;
    sender->since_full = 0;
    return true;
}

static void skn_choose_chunks(skn_sender_t *sender, const skn_code_t *codes, bool full)
{
    for (uint16_t chunk = 0; chunk < SKN_CHUNKS; chunk++) {
        uint16_t count;
        const uint16_t first = skn_codes_of(chunk, &count);
        bool changed = full;

        for (uint16_t at = first; (!changed) && (at < (first + count)); at++) {
            changed = skn_has_changed(codes[at], sender->sent[at], sender->policy.threshold);
        }
        if (changed) {
            skn_take_chunk(sender, codes, chunk, first, count);
        }
    }
}

SKN_API uint16_t skn_sender_begin(skn_sender_t *sender, const skn_code_t *codes, uint8_t counter, uint8_t flags,
                                  uint32_t time_us)
{
    (void)memset(sender->due, 0, sizeof sender->due);
    sender->next = 0;
    sender->chunks_due = 0;
    sender->chunks_sent = 0;
    sender->counter = counter;
    sender->time_us = time_us;
    sender->flags = (uint8_t)(SKN_FLAG_CHECKED | ((uint32_t)sender->phase << SKN_PHASE_SHIFT));
    if ((flags & SKN_FLAG_SOURCE_FAILED) != 0u) {
        sender->flags = (uint8_t)(sender->flags | SKN_FLAG_SOURCE_FAILED);
        sender->full_due = true;
        sender->check = skn_check_of_codes(codes);
    } else {
        const bool full = skn_is_full_scan(sender);

        skn_choose_chunks(sender, codes, full);
        sender->flags = (uint8_t)(sender->flags | (flags & SKN_FLAG_WIRE_FAULT) |
                                  (full ? 0u : SKN_FLAG_CHANGED_ONLY) |
                                  (sender->baseline_changed ? SKN_FLAG_BASELINE_CHANGED : 0u));
        sender->baseline_changed = false;
        sender->check = skn_check_of_codes(sender->sent);
    }
    return sender->chunks_due;
}

SKN_API bool skn_sender_chunk(skn_sender_t *sender, uint8_t *data)
{
    uint16_t count;
    uint16_t first;

    while ((sender->next < SKN_CHUNKS) && (!skn_has(sender->due, sender->next))) {
        sender->next++;
    }
    if (sender->next >= SKN_CHUNKS) {
        return false;
    }
    first = skn_codes_of(sender->next, &count);
    (void)memset(data, 0, SKN_CHUNK_BYTES);
#if SKN_FD
    data[0] = (uint8_t)(sender->next / SKN_CHUNKS_PER_LINE);
    data[2] = (uint8_t)((sender->next % SKN_CHUNKS_PER_LINE) * SKN_CODES_PER_CHUNK);
#else
    data[0] = (uint8_t)sender->next;
#endif
    data[1] = sender->counter;
    for (uint32_t at = 0; at < count; at++) {
        skn_put_code(&data[SKN_CHUNK_HEAD_BYTES + (at * SKN_CODE_BYTES)], sender->sent[first + at]);
    }
    return true;
}

SKN_API void skn_sender_advance(skn_sender_t *sender, bool sent)
{
    if (sender->next < SKN_CHUNKS) {
        sender->next++;
        sender->chunks_sent = (uint16_t)(sender->chunks_sent + (sent ? 1u : 0u));
    }
}

SKN_API void skn_sender_end(const skn_sender_t *sender, uint8_t *data)
{
    data[0] = sender->counter;
    data[1] = (uint8_t)(sender->flags | ((sender->chunks_sent != sender->chunks_due) ? SKN_FLAG_OVERRUN : 0u));
    skn_put_u16(&data[2], sender->chunks_sent);
    skn_put_u16(&data[4], (uint16_t)((sender->time_us >> SKN_TIME_SHIFT) & 0xFFFFu));
    skn_put_u16(&data[6], skn_crc16(sender->check, data, SKN_SUMMARY_HEAD_BYTES));
}

SKN_API void skn_summary_record(const skn_sender_t *sender, const uint8_t *summary, uint8_t *record)
{
    (void)memcpy(record, summary, 4);
    skn_put_u16(&record[4], (uint16_t)(sender->time_us & 0xFFFFu));
    skn_put_u16(&record[6], (uint16_t)(sender->time_us >> 16));
    (void)memcpy(&record[8], &summary[4], 4);
}

/* ======================================================================================================== */
/* Master                                                                                                   */
/* ======================================================================================================== */

#define SKN_TIME_WRAP_US (UINT32_C(1) << (16u + SKN_TIME_SHIFT)) /* period of the 16-bit device time */

/* Return the number of a chunk; SKN_CHUNKS if the patch has no such chunk. The length must have been checked. */
static uint16_t skn_index_of(const uint8_t *data)
{
#if SKN_FD
    if ((data[0] >= SKN_ROWS) || (data[3] != 0u) || (data[2] >= SKN_COLUMNS) ||
        ((data[2] % SKN_CODES_PER_CHUNK) != 0u)) {
        return SKN_CHUNKS;
    }
    return (uint16_t)((data[0] * SKN_CHUNKS_PER_LINE) + (data[2] / SKN_CODES_PER_CHUNK));
#else
    const uint32_t index = data[0];

    return (uint16_t)((index < SKN_CHUNKS) ? index : SKN_CHUNKS);
#endif
}

/* Return whether the open or last scan has this chunk with these codes. */
static bool skn_is_known_chunk(const skn_assembler_t *a, uint16_t index, const uint8_t *data)
{
    return skn_has(a->arrived, index) &&
           (memcmp(a->bodies[index], &data[SKN_CHUNK_HEAD_BYTES], SKN_BODY_BYTES) == 0);
}

static void skn_store_chunk(skn_assembler_t *a, uint16_t index, const uint8_t *data)
{
    skn_add(a->arrived, index);
    (void)memcpy(a->bodies[index], &data[SKN_CHUNK_HEAD_BYTES], SKN_BODY_BYTES);
    a->received++;
    a->stats.chunks_accepted++;
}

/* Return by how many scans a counter is ahead of the last counter, modulo the counter range. */
static uint16_t skn_ahead(const skn_assembler_t *a, uint8_t counter)
{
    return (uint16_t)(((uint32_t)counter + a->range - a->counter) % a->range);
}

/* Return whether a frame starts a new scan. If not, count it as late, duplicate or invalid. */
static bool skn_is_news(skn_assembler_t *a, uint8_t counter, int64_t t_us, bool is_known)
{
    const uint32_t place = (uint32_t)counter - a->lowest; /* wraps below the lowest counter */
    bool news = false;

    if (place >= a->range) {
        a->stats.bad_counter++;
    } else if (!a->counter_known) {
        news = true;
    } else {
        const uint16_t ahead = skn_ahead(a, counter);

        if (ahead == 0u) {
            news = t_us > a->expires_us;
        } else {
            news = (ahead <= (a->range / 2u)) || (t_us > (a->last_us + a->timeout_us));
        }
        if (!news) {
            if ((ahead == 0u) && is_known) {
                a->stats.duplicates++;
            } else {
                a->stats.late++;
            }
        }
    }
    return news;
}

static void skn_open(skn_assembler_t *a, uint8_t counter, int64_t t_us, bool from_its_begin)
{
    /* Steps to this scan, from 1 to the counter range. Before the first scan, `counter` belongs to no scan. */
    uint32_t steps = skn_ahead(a, counter);

    steps = (steps == 0u) ? a->range : steps;
    a->follows = false;
    a->joined_late = a->may_join && (!from_its_begin);
    a->may_join = false;
    if (!a->number_known) {
        a->number = counter;
    } else if (!a->counter_known) { /* after a reset, continue from the last number */
        const uint32_t range = a->range;
        const uint32_t after = (((uint32_t)counter + range) - (a->number % range)) % range;

        a->number += (after == 0u) ? range : after;
    } else {
        a->number += steps;
        if (steps <= (a->range / 2u)) {
            a->stats.scans_missed += steps - 1u;
            a->follows = (steps == 1u) && (t_us <= (a->last_us + a->timeout_us));
        } else {
            a->stats.resyncs++;
        }
    }
    a->number_known = true;
    a->counter_known = true;
    a->open = true;
    a->counter = counter;
    (void)memset(a->arrived, 0, sizeof a->arrived);
    a->mixed = false;
    a->received = 0;
    a->has_summary = false;
    a->first_us = t_us;
    a->last_us = t_us;
    a->expires_us = t_us + a->timeout_us;
}

/* Return whether all codes are known, and write the CRC over them. */
static bool skn_check_of_known(const skn_assembler_t *a, uint16_t *check)
{
    uint16_t crc = SKN_CRC_INITIAL;

    for (uint16_t chunk = 0; chunk < SKN_CHUNKS; chunk++) {
        uint16_t count;

        if (!skn_has(a->known, chunk)) {
            return false;
        }
        (void)skn_codes_of(chunk, &count);
        crc = skn_crc16(crc, a->bodies[chunk], count * SKN_CODE_BYTES);
    }
    *check = crc;
    return true;
}

static void skn_write_codes(const skn_assembler_t *a, uint32_t *codes)
{
    for (uint16_t chunk = 0; chunk < SKN_CHUNKS; chunk++) {
        uint16_t count;
        const uint16_t first = skn_codes_of(chunk, &count);
        const bool is_known = skn_has(a->known, chunk);

        for (uint32_t at = 0; at < count; at++) {
            codes[first + at] = is_known ? skn_get_code(&a->bodies[chunk][at * SKN_CODE_BYTES]) : SKN_CODE_MISSING;
        }
    }
}

/* Keep the codes of the closed scan, and of unsent chunks if these are unchanged. */
static void skn_keep_codes(skn_assembler_t *a, bool carry)
{
    for (size_t at = 0; at < sizeof a->known; at++) {
        a->known[at] = (uint8_t)(a->arrived[at] | (carry ? a->known[at] : 0u));
    }
}

/* Discard all codes after a scan was discarded. doubt: whether that scan may have announced a new baseline. */
static skn_verdict_t skn_discard(skn_assembler_t *a, skn_verdict_t verdict, bool doubt)
{
    (void)memset(a->known, 0, sizeof a->known);
    a->stats.baseline_doubts += doubt ? 1u : 0u;
    return verdict;
}

/* Restore the upper bits of a 16-bit device time: choose the time nearest to that expected from the master's clock. */
static uint32_t skn_restore_time(skn_assembler_t *a, uint32_t low_us)
{
    const int64_t elapsed_us = a->summary_us - a->time_at_us;
    uint32_t expected = a->time_us + (uint32_t)elapsed_us;
    uint32_t off;

    if (a->time_at_us == 0) {
        expected -= SKN_TIME_WRAP_US / 4u;
    }
    off = ((low_us - expected) + (SKN_TIME_WRAP_US / 2u)) & (SKN_TIME_WRAP_US - 1u);
    a->time_us = (expected + off) - (SKN_TIME_WRAP_US / 2u);
    a->time_at_us = a->summary_us;
    return a->time_us;
}

/* Count the losses of a published scan, and write the scan. */
static void skn_publish(skn_assembler_t *a, uint16_t expected, skn_scan_t *scan)
{
    scan->device_time_us = 0;
    scan->flags = 0;
    if (a->has_summary) {
        const uint32_t low = (uint32_t)skn_get_u16(&a->summary[4]);

        scan->flags = a->summary[1];
        a->changed_only = (scan->flags & SKN_FLAG_CHANGED_ONLY) != 0u;
        scan->device_time_us = ((scan->flags & SKN_FLAG_CHECKED) != 0u)
                                   ? skn_restore_time(a, low << SKN_TIME_SHIFT)
                                   : (low | ((uint32_t)skn_get_u16(&a->summary[6]) << 16));
    } else {
        a->stats.summaries_lost++;
    }
    if ((a->has_summary || (!a->changed_only)) && (expected > a->received)) {
        a->stats.chunks_lost += (uint32_t)expected - a->received;
    }
    scan->first_us = a->first_us;
    scan->last_us = a->last_us;
    scan->number = a->number;
    scan->chunks_expected = expected;
    scan->chunks_received = a->received;
    scan->counter = a->counter;
    scan->has_summary = a->has_summary;
    skn_write_codes(a, scan->codes);
}

/* Close the open scan, and publish or discard it. */
static skn_verdict_t skn_close(skn_assembler_t *a, skn_scan_t *scan)
{
    const uint8_t flags = a->has_summary ? a->summary[1] : 0u;
    const uint16_t expected = a->has_summary ? skn_get_u16(&a->summary[2]) : SKN_CHUNKS;
    const bool whole = a->has_summary && (a->received >= expected);
    const bool summary_is_last = a->has_summary && (a->last_us == a->summary_us);
    const int64_t chunk_us = summary_is_last ? a->chunk_us : a->last_us;
    const bool has_check = a->has_summary ? ((flags & SKN_FLAG_CHECKED) != 0u) : a->checked;
    bool arrived = a->received == SKN_CHUNKS;
    bool verified = false;
    uint16_t check = 0;
    skn_verdict_t verdict;

    a->open = false;
    if (a->mixed || ((!whole) && ((chunk_us - a->first_us) > a->longest_us))) {
        a->stats.scans_mixed++;
        return skn_discard(a, SKN_SCAN_MIXED, true);
    }
    if (a->has_summary && (!arrived)) {
        arrived = (a->received == expected) &&
                  ((flags & (SKN_FLAG_CHANGED_ONLY | SKN_FLAG_OVERRUN)) == SKN_FLAG_CHANGED_ONLY);
    }
    if (a->joined_late && (!arrived)) {
        a->stats.scans_joined++;
        return skn_discard(a, SKN_SCAN_JOINED, (!a->has_summary) || ((flags & SKN_FLAG_BASELINE_CHANGED) != 0u));
    }
    skn_keep_codes(a, arrived && a->follows);
    if (arrived && a->has_summary && has_check && skn_check_of_known(a, &check)) {
        verified = skn_crc16(check, a->summary, SKN_SUMMARY_HEAD_BYTES) == skn_get_u16(&a->summary[6]);
        if (!verified) {
            a->stats.scans_corrupt++;
            return skn_discard(a, SKN_SCAN_CORRUPT, true);
        }
        a->checked = true;
    }
    if (!arrived) {
        a->stats.scans_torn++;
        verdict = SKN_SCAN_TORN;
    } else if (verified || (!has_check)) {
        a->stats.scans_complete++;
        verdict = SKN_SCAN_COMPLETE;
    } else {
        a->stats.scans_unchecked++;
        verdict = SKN_SCAN_UNCHECKED;
    }
    skn_publish(a, expected, scan);
    return verdict;
}

static bool skn_is_published(skn_verdict_t verdict)
{
    return (verdict == SKN_SCAN_COMPLETE) || (verdict == SKN_SCAN_TORN) || (verdict == SKN_SCAN_UNCHECKED);
}

SKN_API bool skn_assembler_init(skn_assembler_t *assembler, const skn_settings_t *settings)
{
    const uint8_t overflow = settings->counter_overflow;
    int64_t periods;

    if ((settings->period_us <= 0) || (settings->grace_us <= 0) || (overflow == 1u) || (overflow > 240u)) {
        return false;
    }
    (void)memset(assembler, 0, sizeof *assembler);
    assembler->node_id = settings->node_id;
    assembler->lowest = (uint8_t)((overflow == 0u) ? 0u : 1u);
    assembler->range = (uint16_t)((overflow == 0u) ? 256u : overflow);
    periods = ((int64_t)assembler->range - 1) / 2;
    periods = (periods < 1) ? 1 : periods;
    periods = (periods > 3) ? 3 : periods;
    assembler->timeout_us = settings->period_us * periods;
    assembler->longest_us = settings->period_us * ((periods == 3) ? 2 : periods);
    assembler->grace_us = settings->grace_us;
    assembler->may_join = settings->under_way;
    return true;
}

SKN_API void skn_assembler_reset(skn_assembler_t *assembler, bool under_way, bool checked)
{
    if (assembler->open) {
        assembler->stats.scans_discarded++;
    }
    assembler->open = false;
    assembler->counter_known = false;
    assembler->changed_only = false;
    assembler->may_join = under_way;
    assembler->checked = checked;
    assembler->time_us = 0;
    assembler->time_at_us = 0;
}

SKN_API bool skn_assembler_deadline(const skn_assembler_t *assembler, int64_t *t_us)
{
    const skn_assembler_t *a = assembler;
    const int64_t grace_us = a->last_us + a->grace_us;

    *t_us = a->expires_us;
    if (a->has_summary && (a->received >= skn_get_u16(&a->summary[2]))) {
        *t_us = a->last_us;
    } else if ((a->has_summary || (a->received == SKN_CHUNKS)) && (grace_us < a->expires_us)) {
        *t_us = grace_us;
    } else {
        /* the open scan may still become complete */
    }
    return a->open;
}

SKN_API skn_verdict_t skn_assembler_poll(skn_assembler_t *assembler, int64_t t_us, skn_scan_t *scan)
{
    int64_t deadline_us;

    if (skn_assembler_deadline(assembler, &deadline_us) && (t_us >= deadline_us)) {
        return skn_close(assembler, scan);
    }
    return SKN_NO_SCAN;
}

SKN_API skn_verdict_t skn_assembler_chunk(skn_assembler_t *assembler, const uint8_t *data, uint8_t length,
                                          int64_t t_us, skn_scan_t *scan)
{
    skn_assembler_t *a = assembler;
    skn_verdict_t verdict = SKN_NO_SCAN;
    uint16_t index;

    if (length != SKN_CHUNK_BYTES) {
        a->stats.bad_length++;
        return SKN_NO_SCAN;
    }
    index = skn_index_of(data);
    if (index >= SKN_CHUNKS) {
        a->stats.bad_index++;
    } else if (a->open && (data[1] == a->counter) && (t_us <= a->expires_us)) {
        if (!skn_has(a->arrived, index)) {
            skn_store_chunk(a, index, data);
            a->last_us = t_us;
            if (a->has_summary && (a->received == skn_get_u16(&a->summary[2]))) {
                verdict = skn_close(a, scan);
            }
        } else if (skn_is_known_chunk(a, index, data)) {
            a->stats.duplicates++;
        } else {
            a->stats.conflicts++;
            a->mixed = true;
        }
    } else if (skn_is_news(a, data[1], t_us, skn_is_known_chunk(a, index, data))) {
        verdict = a->open ? skn_close(a, scan) : SKN_NO_SCAN;
        skn_open(a, data[1], t_us, index == 0u);
        skn_store_chunk(a, index, data);
    } else {
        /* counted by skn_is_news */
    }
    return verdict;
}

SKN_API skn_verdict_t skn_assembler_summary(skn_assembler_t *assembler, const uint8_t *data, uint8_t length,
                                            int64_t t_us, skn_scan_t *scan)
{
    skn_assembler_t *a = assembler;
    skn_verdict_t verdict = SKN_NO_SCAN;
    bool is_known;

    if (length != SKN_SUMMARY_BYTES) {
        a->stats.bad_length++;
        return SKN_NO_SCAN;
    }
    if (((data[1] & SKN_FLAG_CHECKED) == 0u) && a->checked) {
        a->stats.bad_form++;
        return SKN_NO_SCAN;
    }
    if (skn_get_u16(&data[2]) > SKN_CHUNKS) {
        a->stats.bad_index++;
        return SKN_NO_SCAN;
    }
    is_known = a->has_summary && (memcmp(a->summary, data, SKN_SUMMARY_BYTES) == 0);
    if (a->open && (data[0] == a->counter) && (t_us <= a->expires_us)) {
        if (a->has_summary) {
            if (is_known) {
                a->stats.duplicates++;
            } else {
                a->stats.conflicts++;
                a->mixed = true;
            }
            return SKN_NO_SCAN;
        }
    } else {
        if (!skn_is_news(a, data[0], t_us, is_known)) {
            return SKN_NO_SCAN;
        }
        verdict = a->open ? skn_close(a, scan) : SKN_NO_SCAN;
        skn_open(a, data[0], t_us, false);
    }
    (void)memcpy(a->summary, data, SKN_SUMMARY_BYTES);
    a->has_summary = true;
    a->stats.summaries_accepted++;
    a->chunk_us = a->last_us;
    a->summary_us = t_us;
    a->last_us = t_us;
    if ((!skn_is_published(verdict)) && (a->received >= skn_get_u16(&a->summary[2]))) {
        verdict = skn_close(a, scan);
    }
    return verdict;
}

SKN_API skn_verdict_t skn_assembler_frame(skn_assembler_t *assembler, uint32_t cob_id, const uint8_t *data,
                                          uint8_t length, int64_t t_us, skn_scan_t *scan)
{
    if (cob_id == (SKN_COB_ID_CHUNK + (uint32_t)assembler->node_id)) {
        return skn_assembler_chunk(assembler, data, length, t_us, scan);
    }
    if (cob_id == (SKN_COB_ID_SUMMARY + (uint32_t)assembler->node_id)) {
        return skn_assembler_summary(assembler, data, length, t_us, scan);
    }
    return SKN_NO_SCAN;
}
