/* Runs the C99 kit for tests. A request on stdin and its reply on stdout are a u32 length and that many bytes.
 *
 * A request holds any number of commands: a letter and its arguments, little-endian. Payloads are copied into blocks
 * of their exact length, so that a sanitizer sees each access beyond them. */
#include "skinnode_patch.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint8_t *request, *reply;
static size_t at, length, written, capacity;

static void fail(const char *what)
{
    (void)fprintf(stderr, "driver: %s at byte %lu\n", what, (unsigned long)at);
    exit(3);
}

static const uint8_t *take(size_t n)
{
    const uint8_t *bytes = &request[at];

    if (n > length - at) {
        fail("request too short");
    }
    at += n;
    return bytes;
}

static uint64_t take_number(size_t n)
{
    const uint8_t *bytes = take(n);
    uint64_t value = 0;

    for (size_t i = n; i-- > 0;) {
        value = value << 8 | bytes[i];
    }
    return value;
}

#define U8() ((uint8_t)take_number(1))
#define U16() ((uint16_t)take_number(2))
#define U32() ((uint32_t)take_number(4))
#define I64() ((int64_t)take_number(8))

static void put(const void *bytes, size_t n)
{
    if (written + n > capacity) {
        capacity = 2 * (written + n);
        reply = realloc(reply, capacity);
        if (reply == NULL) {
            fail("no memory");
        }
    }
    memcpy(&reply[written], bytes, n);
    written += n;
}

static void put_number(uint64_t value, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        const uint8_t byte = (uint8_t)(value >> 8 * i);

        put(&byte, 1);
    }
}

static uint8_t *block(size_t n)
{
    uint8_t *bytes = malloc(n > 0 ? n : 1);

    if (bytes == NULL) {
        fail("no memory");
    }
    return bytes;
}

static skn_sender_t sender;
static skn_assembler_t assembler;
static skn_scan_t scan;

static skn_code_t *take_codes(void)
{
    skn_code_t *codes = (skn_code_t *)(void *)block(SKN_CODES * sizeof(skn_code_t));

    for (size_t i = 0; i < SKN_CODES; i++) {
        codes[i] = (skn_code_t)U32();
    }
    return codes;
}

static void find_wire_faults(void)
{
    skn_code_t *codes = take_codes();
    skn_wire_faults_t faults;

    put_number(skn_find_wire_faults(codes, &faults), 1);
    for (size_t i = 0; i < SKN_FAULT_WORDS(SKN_ROWS); i++) {
        put_number(faults.upper[i], 4);
    }
    for (size_t i = 0; i < SKN_FAULT_WORDS(SKN_COLUMNS); i++) {
        put_number(faults.lower[i], 4);
    }
    free(codes);
}

/* Send a scan; the bus refuses the chunk with number `refused`, and the sender stops before number `stop`. */
static void send_scan(void)
{
    const uint8_t counter = U8();
    const uint8_t flags = U8();
    const uint32_t time_us = U32();
    const uint16_t refused = U16();
    const uint16_t stop = U16();
    skn_code_t *codes = take_codes();
    const uint16_t due = skn_sender_begin(&sender, codes, counter, flags, time_us);
    uint8_t *data = block(SKN_CHUNK_BYTES);
    uint8_t *summary = block(SKN_SUMMARY_BYTES);
    uint8_t *record = block(SKN_SUMMARY_RECORD_BYTES);
    uint16_t n = 0;

    memset(codes, 0x55, SKN_CODES * sizeof(skn_code_t)); /* the next conversion overwrites them */
    put_number(due, 2);
    while (n < stop && skn_sender_chunk(&sender, data)) {
        if (n != refused) {
            put_number(SKN_COB_ID_CHUNK, 4);
            put_number(SKN_CHUNK_BYTES, 1);
            put(data, SKN_CHUNK_BYTES);
        }
        skn_sender_advance(&sender, n != refused);
        n++;
    }
    skn_sender_end(&sender, summary);
    skn_summary_record(&sender, summary, record);
    put_number(SKN_COB_ID_SUMMARY, 4);
    put_number(SKN_SUMMARY_BYTES, 1);
    put(summary, SKN_SUMMARY_BYTES);
    put(record, SKN_SUMMARY_RECORD_BYTES);
    free(codes);
    free(data);
    free(summary);
    free(record);
}

static void put_verdict(skn_verdict_t verdict)
{
    int64_t deadline_us;

    put_number((uint64_t)verdict, 1);
    put_number(skn_assembler_deadline(&assembler, &deadline_us), 1);
    put_number((uint64_t)deadline_us, 8);
    if (verdict != SKN_SCAN_COMPLETE && verdict != SKN_SCAN_TORN && verdict != SKN_SCAN_UNCHECKED) {
        return;
    }
    put_number((uint64_t)scan.first_us, 8);
    put_number((uint64_t)scan.last_us, 8);
    put_number(scan.number, 4);
    put_number(scan.device_time_us, 4);
    put_number(scan.chunks_expected, 2);
    put_number(scan.chunks_received, 2);
    put_number(scan.counter, 1);
    put_number(scan.flags, 1);
    put_number(scan.has_summary, 1);
    for (size_t i = 0; i < SKN_CODES; i++) {
        put_number(scan.codes[i], 4);
    }
}

static void receive(void)
{
    const uint32_t cob_id = U32();
    const int64_t t_us = I64();
    const uint8_t n = U8();
    uint8_t *data = block(n);

    memcpy(data, take(n), n);
    memset(&scan, 0x55, sizeof scan);
    put_verdict(skn_assembler_frame(&assembler, cob_id, data, n, t_us, &scan));
    free(data);
}

static void set_up_assembler(void)
{
    skn_settings_t settings;

    settings.period_us = I64();
    settings.grace_us = I64();
    settings.node_id = U8();
    settings.counter_overflow = U8();
    settings.under_way = U8() != 0;
    put_number(skn_assembler_init(&assembler, &settings), 1);
}

static void put_stats(void)
{
    uint32_t counters[sizeof(skn_stats_t) / sizeof(uint32_t)];

    memcpy(counters, &assembler.stats, sizeof counters);
    for (size_t i = 0; i < sizeof counters / sizeof counters[0]; i++) {
        put_number(counters[i], 4);
    }
}

static void encode(uint8_t command)
{
    const uint32_t resistance = U32();
    const uint8_t fraction_bits = command == 'e' ? U8() : 0;
    const uint32_t baseline = U32();

    put_number(command == 'e' ? skn_encode(resistance, fraction_bits, baseline)
                              : skn_encode_ratio(resistance, baseline), 4);
}

static void convert(uint8_t command)
{
    if (command == 'd') {
        const uint32_t reference = U32();
        const uint32_t reading = U32();
        const uint32_t full_scale = U32();

        put_number(skn_divider(reference, reading, full_scale), 4);
    } else {
        const uint64_t value = take_number(8);
        const uint8_t fraction_bits = U8();

        put_number(skn_real32(value, fraction_bits), 4);
    }
}

static void set_policy(void)
{
    sender.policy.mode = U8();
    sender.policy.threshold = U16();
    sender.policy.refresh = U16();
    skn_sender_full(&sender);
}

static void run(uint8_t command)
{
    switch (command) {
    case 'e': case 'q': encode(command); break;
    case 'd': case 'f': convert(command); break;
    case 'w': find_wire_faults(); break;
    case 'I': skn_sender_init(&sender); break;
    case 'P': set_policy(); break;
    case 'F': skn_sender_full(&sender); break;
    case 'B': skn_sender_baseline_changed(&sender); break;
    case 'V': skn_sender_conversions(&sender, U32()); break;
    case 'S': send_scan(); break;
    case 'A': set_up_assembler(); break;
    case 'R': {
        const bool under_way = U8() != 0;

        skn_assembler_reset(&assembler, under_way, U8() != 0);
        break;
    }
    case 'C': receive(); break;
    case 'p': memset(&scan, 0x55, sizeof scan); put_verdict(skn_assembler_poll(&assembler, I64(), &scan)); break;
    case 'T': put_stats(); break;
    default: fail("unknown command");
    }
}

static bool read_request(void)
{
    uint8_t head[4];

    if (fread(head, 1, sizeof head, stdin) != sizeof head) {
        return false;
    }
    length = (size_t)head[0] | (size_t)head[1] << 8 | (size_t)head[2] << 16 | (size_t)head[3] << 24;
    free(request);
    request = block(length);
    at = 0;
    return fread(request, 1, length, stdin) == length;
}

int main(void)
{
    skn_sender_init(&sender);
    while (read_request()) {
        uint8_t head[4];

        written = 0;
        while (at < length) {
            run(U8());
        }
        for (size_t i = 0; i < sizeof head; i++) {
            head[i] = (uint8_t)(written >> 8 * i);
        }
        (void)fwrite(head, 1, sizeof head, stdout);
        (void)fwrite(reply, 1, written, stdout);
        (void)fflush(stdout);
    }
    free(request);
    free(reply);
    return 0;
}
