/* What tools/c_kit measures: the work for one scan, in steps, on data as a press makes it. */
#include "skinnode_patch.h"

#define NODE_ID 4u

skn_sender_t sender;
skn_assembler_t assembler;
skn_scan_t scan;

static uint32_t resistances[SKN_CODES];
static uint32_t baselines[SKN_CODES];
static skn_code_t codes[SKN_CODES];
static uint8_t chunks[SKN_CHUNKS][SKN_CHUNK_BYTES];
static uint8_t summary[SKN_SUMMARY_BYTES];
static skn_wire_faults_t faults;

void measure_setup(void);
void measure_encode(void);
void measure_wires(void);
void measure_begin(void);
void measure_chunks(void);
void measure_summary(void);
void measure_receive(void);
void measure_close(void);

/* R0 of 500 to 5000 ohm, in 1/256 ohm, and R of 0.5 to 1.1 R0. */
void measure_setup(void)
{
    const skn_settings_t settings = {80000, 5000, NODE_ID, 240, false};
    uint32_t random = 1;

    for (uint32_t at = 0; at < SKN_CODES; at++) {
        uint32_t r0;

        random = (random * 1103515245u) + 12345u;
        r0 = 128000u + ((random >> 16) * 17u);
        random = (random * 1103515245u) + 12345u;
        baselines[at] = skn_real32(r0, 8);
        resistances[at] = (r0 / 2u) + ((r0 / 1000u) * ((random >> 16) % 600u));
    }
    skn_sender_init(&sender);
    (void)skn_assembler_init(&assembler, &settings);
}

void measure_encode(void)
{
    for (uint32_t at = 0; at < SKN_CODES; at++) {
        codes[at] = skn_encode(resistances[at], 8, baselines[at]);
    }
}

void measure_wires(void)
{
    (void)skn_find_wire_faults(codes, &faults);
}

void measure_begin(void)
{
    (void)skn_sender_begin(&sender, codes, 1, 0, 1000000);
}

void measure_chunks(void)
{
    while (skn_sender_chunk(&sender, chunks[sender.next])) {
        skn_sender_advance(&sender, true);
    }
}

void measure_summary(void)
{
    skn_sender_end(&sender, summary);
}

void measure_receive(void)
{
    for (uint32_t at = 0; at < SKN_CHUNKS; at++) {
        (void)skn_assembler_frame(&assembler, SKN_COB_ID_CHUNK + NODE_ID, chunks[at], SKN_CHUNK_BYTES, 1000, &scan);
    }
}

void measure_close(void)
{
    if (skn_assembler_frame(&assembler, SKN_COB_ID_SUMMARY + NODE_ID, summary, SKN_SUMMARY_BYTES, 2000, &scan) !=
        SKN_SCAN_COMPLETE) {
        scan.number = 0; /* the tool reads this number: no scan, no figures */
    }
}

#ifdef SKN_HOSTED
int main(void)
{
    measure_setup();
    measure_encode();
    measure_wires();
    measure_begin();
    measure_chunks();
    measure_summary();
    measure_receive();
    measure_close();
    return (scan.number == 1u) ? 0 : 1;
}
#endif
