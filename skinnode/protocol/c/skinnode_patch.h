/* Written by skinnode eds --c. MIT licence.
 *
 * Packs the scans of a skinnode patch on a board, and assembles them on a foreign master, in C99.
 *
 * No allocation, no floating point, no recursion, no global state: the caller owns every structure. No CANopen
 * stack: the functions read and write payloads, and your stack sends and receives the frames. No function blocks,
 * and every loop is bounded by a size in skinnode_patch_config.h, the only file that depends on the patch.
 *
 * Board:   skn_encode for each crossing, skn_sender_begin at a SYNC, then skn_sender_chunk and
 *          skn_sender_advance for each chunk, and skn_sender_end for the summary.
 * Master:  skn_assembler_frame for each received frame, and skn_assembler_poll after each batch of frames and at
 *          the time given by skn_assembler_deadline.
 *
 * Deviations from MISRA C:2012 found by cppcheck: functions return early (rule 15.5); a program may leave macros
 * and functions unused (2.5, 8.7); the type and the operator ## of static assertions, which C99 lacks (2.3, 20.10).
 *
 * Functions are not thread-safe: one sender or assembler belongs to one context (task or interrupt level).
 *
 * Patches of several sizes in one program: generate one folder per size. For each, compile one source file that
 * defines SKN_API as "static inline" and includes that folder's skinnode_patch.c.
 */
#ifndef SKINNODE_PATCH_H
#define SKINNODE_PATCH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "skinnode_patch_config.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifndef SKN_API
#define SKN_API /* linkage of all functions; external unless defined otherwise */
#endif

/* --- sizes that follow from the configuration */

#define SKN_CODES (SKN_ROWS * SKN_COLUMNS)                    /* codes in a scan */
#define SKN_BODY_BYTES (SKN_CHUNK_BYTES - SKN_CHUNK_HEAD_BYTES) /* bytes of a chunk after its head */
#define SKN_CODE_BYTES (SKN_CODE_BITS / 8u)
#define SKN_SUMMARY_BYTES 8u
#define SKN_SUMMARY_HEAD_BYTES 6u /* leading bytes of a summary that the scan check covers */
#define SKN_SUMMARY_RECORD_BYTES 12u
#define SKN_BITSET_BYTES(n) (((n) + 7u) / 8u)
#define SKN_FAULT_WORDS(wires) (2u * (((wires) + 31u) / 32u))

/* --- codes
 *
 * A resistance R is encoded as round((R/R0 - lo) / (hi - lo) * SKN_CODE_STEPS), ties to even, computed exactly.
 * The three codes above SKN_CODE_STEPS are reserved. */

#define SKN_CODE_STEPS ((UINT32_C(1) << SKN_CODE_BITS) - 4u) /* highest measurement */
#define SKN_CODE_OVER_RANGE (SKN_CODE_STEPS + 1u)            /* outside the code range, or no baseline */
#define SKN_CODE_SHORT (SKN_CODE_STEPS + 2u)
#define SKN_CODE_OPEN (SKN_CODE_STEPS + 3u)
#define SKN_CODE_MISSING UINT32_MAX    /* in a received scan: the code is unknown */
#define SKN_OPEN_CIRCUIT UINT32_MAX    /* resistance of an open crossing */
#define SKN_SHORT_CIRCUIT UINT32_C(0)  /* resistance of a shorted crossing */

#if SKN_CODE_BITS == 16
typedef uint16_t skn_code_t;
#else
typedef uint32_t skn_code_t;
#endif

/* ======================================================================================================== */
/* Board                                                                                                    */
/* ======================================================================================================== */

/* Send policy, object SKN_OD_SEND_POLICY. Call skn_sender_full after each write. */
typedef struct {
    uint8_t mode;       /* sub-index 1: 0 all chunks, 1 only changed chunks */
    uint16_t threshold; /* sub-index 2: largest change in a code that is not sent, codes */
    uint16_t refresh;   /* sub-index 3: interval between full scans, scans; 0 for none */
} skn_policy_t;

/* Sender of the scans of one patch. Write only `policy`; use the functions for everything else. */
typedef struct {
    skn_policy_t policy;
    uint32_t time_us;                          /* time of the scan on the node's clock, wraps at 2^32 */
    uint32_t conversions;                      /* conversion count at the last scan */
    uint16_t check;                            /* CRC over the codes that a receiver has after this scan */
    uint16_t next;                             /* next chunk to examine */
    uint16_t chunks_due;                       /* chunks of this scan */
    uint16_t chunks_sent;                      /* chunks of this scan accepted by the bus */
    uint16_t since_full;                       /* scans since the last full scan; stops at 65535 */
    uint8_t counter;                           /* scan counter */
    uint8_t flags;                             /* flags of this scan's summary */
    uint8_t phase;                             /* conversion phase, 0 to 3 */
    bool full_due;                             /* whether the next scan must be a full scan */
    bool counted;                              /* whether `conversions` is known */
    bool baseline_changed;                     /* whether the next summary announces a new baseline */
    uint8_t due[SKN_BITSET_BYTES(SKN_CHUNKS)]; /* set of the chunks to send in this scan */
    skn_code_t sent[SKN_CODES];                /* codes last sent, ordered by upper wire */
} skn_sender_t;

/* Open and shorted wires, in the order of the sub-indices of SKN_OD_UPPER_WIRE_FAULTS and
 * SKN_OD_LOWER_WIRE_FAULTS: for every 32 wires, a mask of the open wires and a mask of the shorted wires. */
typedef struct {
    uint32_t upper[SKN_FAULT_WORDS(SKN_ROWS)];
    uint32_t lower[SKN_FAULT_WORDS(SKN_COLUMNS)];
} skn_wire_faults_t;

/* Return the REAL32 pattern of value / 2^fraction_bits (0 to 63 bits), rounded to nearest, ties to even.
 *
 * A baseline is the mean of several readings: pass their sum, and add the base-2 logarithm of their number to
 * fraction_bits. The patterns, as little-endian bytes, are the content of SKN_OD_BASELINE and
 * SKN_OD_BASELINE_DOMAIN. */
SKN_API uint32_t skn_real32(uint64_t value, uint8_t fraction_bits);

/* Return the code of a resistance.
 *
 * resistance: in ohm / 2^fraction_bits (0 to 31 bits); SKN_SHORT_CIRCUIT and SKN_OPEN_CIRCUIT have their own codes.
 * baseline: R0 in ohm, as a REAL32 pattern. If R0 is not positive and finite, the code is over-range. */
SKN_API skn_code_t skn_encode(uint32_t resistance, uint8_t fraction_bits, uint32_t baseline);

/* Return the code of a resistance, given R and R0 in any common unit. An R0 of 0 means no baseline. */
SKN_API skn_code_t skn_encode_ratio(uint32_t resistance, uint32_t baseline);

/* Return the resistance between a supply and an input with a reference resistor to ground, in the unit of the
 * reference: reference * (full_scale - reading) / reading, rounded to nearest.
 *
 * A reading of 0 is an open circuit. A reading of full_scale or more is a short circuit. */
SKN_API uint32_t skn_divider(uint32_t reference, uint32_t reading, uint32_t full_scale);

/* Find the wires whose crossings are all open or all shorted, and return whether there are any.
 *
 * If so, pass SKN_FLAG_WIRE_FAULT to skn_sender_begin. codes: SKN_CODES codes, ordered by upper wire. */
SKN_API bool skn_find_wire_faults(const skn_code_t *codes, skn_wire_faults_t *faults);

/* Set up a sender with the default policy: all chunks of every scan. */
SKN_API void skn_sender_init(skn_sender_t *sender);

/* Make the next scan a full scan. Call this function after a write to the send policy, on entry to OPERATIONAL,
 * after a converter failure, and after a scan that was skipped or not sent completely: receivers then no longer know
 * the codes of unsent chunks. */
SKN_API void skn_sender_full(skn_sender_t *sender);

/* Announce a new baseline in the next summary, and make the next scan a full scan. */
SKN_API void skn_sender_baseline_changed(skn_sender_t *sender);

/* Report how often the converter has measured all crossings, once per scan, before skn_sender_begin.
 *
 * Never call this function if the converter does not count; the phase then stays 0. The count may wrap. */
SKN_API void skn_sender_conversions(skn_sender_t *sender, uint32_t conversions);

/* Begin a scan, and return how many chunks it has. A scan that is still being sent is dropped.
 *
 * codes:   SKN_CODES codes, ordered by upper wire. They are copied, so the next conversion may overwrite them. If
 *          the converter failed, pass the codes of the last scan.
 * counter: SYNC counter; if the SYNC has no counter, the last scan's counter + 1.
 * flags:   SKN_FLAG_WIRE_FAULT, SKN_FLAG_SOURCE_FAILED, or 0; all other flags are set by the sender.
 * time_us: time of the scan on the node's clock; wraps at 2^32. */
SKN_API uint16_t skn_sender_begin(skn_sender_t *sender, const skn_code_t *codes, uint8_t counter, uint8_t flags,
                                  uint32_t time_us);

/* Write the payload of the next chunk (SKN_CHUNK_BYTES bytes), and return whether there is one.
 *
 * The same chunk is written again until skn_sender_advance is called. */
SKN_API bool skn_sender_chunk(skn_sender_t *sender, uint8_t *data);

/* Advance to the next chunk. sent: whether the bus accepted this chunk. If not, the summary reports missing chunks. */
SKN_API void skn_sender_advance(skn_sender_t *sender, bool sent);

/* Write the payload of the summary (SKN_SUMMARY_BYTES bytes). Chunks that have not been sent yet count as missing. */
SKN_API void skn_sender_end(const skn_sender_t *sender, uint8_t *data);

/* Write the content of SKN_OD_SUMMARY (SKN_SUMMARY_RECORD_BYTES bytes) for a summary written by skn_sender_end. */
SKN_API void skn_summary_record(const skn_sender_t *sender, const uint8_t *summary, uint8_t *record);

/* Extend a CRC-16/IBM-3740 over `length` bytes. The initial value is SKN_CRC_INITIAL. */
SKN_API uint16_t skn_crc16(uint16_t crc, const uint8_t *data, size_t length);

/* ======================================================================================================== */
/* Master                                                                                                   */
/* ======================================================================================================== */

/* Result for a scan. In the cases COMPLETE, TORN and UNCHECKED, the scan was written to the caller's skn_scan_t;
 * in the cases MIXED, CORRUPT and JOINED, it was discarded. */
typedef enum {
    SKN_NO_SCAN = 0,
    SKN_SCAN_COMPLETE,  /* the codes are those that the node packed */
    SKN_SCAN_TORN,      /* chunks are missing; their codes are SKN_CODE_MISSING */
    SKN_SCAN_UNCHECKED, /* all chunks arrived, but the check is impossible: no summary, or unsent codes unknown */
    SKN_SCAN_MIXED,     /* the frames belong to two scans with the same counter */
    SKN_SCAN_CORRUPT,   /* the check failed: at least one code is wrong */
    SKN_SCAN_JOINED     /* incomplete, because reception began in the middle of the scan */
} skn_verdict_t;

/* A received scan. */
typedef struct {
    int64_t first_us;         /* arrival of the first frame */
    int64_t last_us;          /* arrival of the last frame */
    uint32_t number;          /* scan counter without wrap-around */
    uint32_t device_time_us;  /* time of the scan on the node's clock, modulo 2^32; valid if has_summary */
    uint16_t chunks_expected; /* chunks sent, according to the summary; SKN_CHUNKS without a summary */
    uint16_t chunks_received;
    uint8_t counter;          /* scan counter, as sent */
    uint8_t flags;            /* SKN_FLAG_...; 0 without a summary */
    bool has_summary;
    uint32_t codes[SKN_CODES]; /* ordered by upper wire; above SKN_CODE_STEPS: no measurement */
} skn_scan_t;

/* Counters of an assembler. They wrap at 2^32. Every frame is counted in exactly one of the fields marked with *. */
typedef struct {
    uint32_t scans_complete;
    uint32_t scans_torn;
    uint32_t scans_unchecked;
    uint32_t scans_missed;    /* scans of which no frame arrived, from gaps in the scan counter */
    uint32_t scans_discarded; /* scans discarded by skn_assembler_reset */
    uint32_t scans_mixed;
    uint32_t scans_corrupt;
    uint32_t scans_joined;
    uint32_t chunks_accepted;    /* * */
    uint32_t summaries_accepted; /* * */
    uint32_t chunks_lost;
    uint32_t summaries_lost;
    uint32_t duplicates;  /* * identical to an earlier frame of the same scan */
    uint32_t conflicts;   /* * different from an earlier frame for the same chunk or summary of a scan */
    uint32_t late;        /* * arrived after their scan was closed or a newer scan had begun */
    uint32_t bad_length;  /* * */
    uint32_t bad_index;   /* * chunks that the patch does not have; summaries with too many chunks */
    uint32_t bad_counter; /* * scan counter outside the range of the SYNC counter */
    uint32_t bad_form;    /* * summaries without a check, although the node sends checks */
    uint32_t resyncs;     /* number of times that the scan counter continued out of sequence after a pause */
    uint32_t baseline_doubts; /* discarded scans that may have announced a new baseline. Read R0 again after one of
                                 these, and after missed scans, lost summaries and resyncs */
} skn_stats_t;

/* Assembler of the scans of one node. Read `stats`; use the functions for everything else. */
typedef struct {
    skn_stats_t stats;
    int64_t timeout_us; /* maximum time from the first to the last frame of a scan */
    int64_t longest_us; /* maximum time between the chunks of an incomplete scan */
    int64_t grace_us;
    int64_t expires_us; /* latest end of the open scan */
    int64_t first_us;   /* arrival of the first frame */
    int64_t last_us;    /* arrival of the last frame */
    int64_t chunk_us;   /* arrival of the last chunk before the summary */
    int64_t summary_us; /* arrival of the summary */
    int64_t time_at_us; /* arrival of the last device time; 0 before the first */
    uint32_t time_us;   /* last device time */
    uint32_t number;    /* scan counter without wrap-around */
    uint16_t received;  /* chunks of the open scan */
    uint16_t range;     /* number of scan counters */
    uint8_t lowest;     /* lowest scan counter */
    uint8_t counter;    /* of the open scan, or of the last scan */
    uint8_t node_id;
    bool open;          /* whether a scan is open */
    bool counter_known; /* whether `counter` is that of an earlier scan */
    bool number_known;  /* whether `number` is that of an earlier scan */
    bool has_summary;   /* whether the summary of the open or last scan arrived */
    bool mixed;         /* whether the open scan has frames of two scans */
    bool may_join;      /* whether the next scan may be joined late */
    bool joined_late;   /* whether the beginning of the open scan may have been missed */
    bool follows;       /* whether the open scan follows the last scan without a gap */
    bool changed_only;  /* whether the last summary announced changed chunks only */
    bool checked;       /* whether every summary must contain a check */
    uint8_t summary[SKN_SUMMARY_BYTES];
    uint8_t arrived[SKN_BITSET_BYTES(SKN_CHUNKS)]; /* chunks of the open or last scan */
    uint8_t known[SKN_BITSET_BYTES(SKN_CHUNKS)];   /* chunks whose codes were known after the last scan */
    uint8_t bodies[SKN_CHUNKS][SKN_BODY_BYTES];    /* last received codes of each chunk */
} skn_assembler_t;

/* Settings of an assembler. All times are in microseconds and greater than 0. */
typedef struct {
    int64_t period_us;        /* scan period */
    int64_t grace_us;         /* maximum wait for frames after the summary or after all chunks; usually 5000 */
    uint8_t node_id;          /* 1 to 127 */
    uint8_t counter_overflow; /* 0x1019 if scans carry the SYNC counter, 2 to 240; 0 if the patch counts scans itself */
    bool under_way;           /* whether the node may already be sending; see skn_assembler_reset */
} skn_settings_t;

/* Set up an assembler. If a setting is out of range, return false and change nothing. */
SKN_API bool skn_assembler_init(skn_assembler_t *assembler, const skn_settings_t *settings);

/* Process a received data frame. Frames whose COB-ID is not that of the node's chunks or summaries are ignored.
 * Never pass remote frames.
 *
 * t_us: arrival time on a monotonic clock; must not be 0, and must not decrease from call to call.
 * scan: written if the result is COMPLETE, TORN or UNCHECKED.
 *
 * A frame may close two scans. If both are published, skn_assembler_poll returns the second scan, so call
 * skn_assembler_poll after each batch of frames. If the first scan is discarded, the result is that of the second. */
SKN_API skn_verdict_t skn_assembler_frame(skn_assembler_t *assembler, uint32_t cob_id, const uint8_t *data,
                                          uint8_t length, int64_t t_us, skn_scan_t *scan);

/* Process a chunk or a summary if its COB-ID is not the default. Otherwise like skn_assembler_frame. */
SKN_API skn_verdict_t skn_assembler_chunk(skn_assembler_t *assembler, const uint8_t *data, uint8_t length,
                                          int64_t t_us, skn_scan_t *scan);
SKN_API skn_verdict_t skn_assembler_summary(skn_assembler_t *assembler, const uint8_t *data, uint8_t length,
                                            int64_t t_us, skn_scan_t *scan);

/* Close the open scan if its missing frames have timed out. */
SKN_API skn_verdict_t skn_assembler_poll(skn_assembler_t *assembler, int64_t t_us, skn_scan_t *scan);

/* Write the earliest time at which skn_assembler_poll closes the open scan, and return whether a scan is open. */
SKN_API bool skn_assembler_deadline(const skn_assembler_t *assembler, int64_t *t_us);

/* Forget the open scan, the scan counter and the device time, for example at a boot-up message of the node.
 *
 * under_way: whether the node may already be sending. If so, the first scan is discarded if its beginning was missed.
 * checked:   whether every summary must contain a check. If false, checks are required once a check has passed. */
SKN_API void skn_assembler_reset(skn_assembler_t *assembler, bool under_way, bool checked);

#ifdef __cplusplus
}
#endif

#endif /* SKINNODE_PATCH_H */
