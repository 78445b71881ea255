// The board: its valves, its sensors and its limits. Edit this file for your hardware, or give a
// number to make (`make BOARD_NUMBER=2 PAIRS=0`). docs/open-regulator.md explains each of them.
#ifndef CONFIG_H
#define CONFIG_H

#ifndef BOARD_NUMBER
#define BOARD_NUMBER 1 // 1 to 254; each board of a lab has its own
#endif
#ifndef PAIRS
#define PAIRS 1 // 1: three channels of a filling and an exhaust valve; 0: six 3-way valves
#endif
#ifndef SILENCE_MS
#define SILENCE_MS 100 // without a valid command for this long the board vents
#endif

#if PAIRS
#define CHANNELS 3
#else
#define CHANNELS 6
#endif
#define OUTPUTS 6

// Pressures are in units of 10 Pa (1 bar is 10000), gauge; rates in units of 10 Pa per ms.
#define MAX_PRESSURE 20000 // no limit that the host sets is above this
#define MAX_SLEW 200       // 20 bar/s
#define ATMOSPHERE 10132

// Sensors: 0.5 V at 0 bar and 4.5 V at 2.5 bar with 5 V supply, in counts of the 10-bit converter.
// ZERO is 16 times the counts at 0 bar, SPAN of 16 times the counts per bar; one of each a channel.
#define SENSOR_ZERO {1638, 1638, 1638, 1638, 1638, 1638}
#define SENSOR_SPAN {SPAN(5243), SPAN(5243), SPAN(5243), SPAN(5243), SPAN(5243), SPAN(5243)}
#define SPAN(counts) ((10000L << 12) / (counts)) // divided here, not by the processor
#define SENSOR_LOWEST 51   // counts: a wire is broken below, or there is a short circuit above
#define SENSOR_HIGHEST 972
// The sensor of the supply line: 0.5 V at 0 bar and 4.5 V at 5 bar.
#define SUPPLY_ZERO 1638
#define SUPPLY_SPAN SPAN(2621)

// Valves: duty (of 255) at which a filling valve, or the filling side of a 3-way valve, begins to
// open and is fully open; the same for exhaust. A 3-way valve that is not energised must exhaust:
// its duty falls from EXHAUST_BEGINS to EXHAUST_FULL. The begins are 2 further than they were
// measured, here 80, 140 and 100: a valve that opens later than it should is worse than earlier.
#define FILL_BEGINS (PAIRS ? 82 : 142)
#define FILL_FULL (PAIRS ? 230 : 240)
#define EXHAUST_BEGINS (PAIRS ? 82 : 98)
#define EXHAUST_FULL (PAIRS ? 230 : 0)

// What a fully open valve does: rate of pressure, in 1/s, per absolute pressure in front of it.
// (sonic conductance in dm3/(s bar)) / (volume in dm3), here 0.2 and 22 ml with the tube.
#define FLOW_RATE 9

// When a reading is not believed, or the arm does not do what it should.
#define OVER_LIMIT 500     // above the channel's limit
#define HEADROOM 200       // below it: what is controlled to at most, as control is not exact
#define FOLLOW_ERROR 1500  // between where the pressure should be and where it is
#define FOLLOW_MS 500      // for this long
#define STUCK_AIR 3000     // so much air was let in, and the reading shows less than a quarter of it

#endif
