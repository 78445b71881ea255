/* Dynamic programming over the candidates of a path; see Sequences in sequences.py. */
#include <math.h>
#include <stdint.h>

/* Set for each of `count` candidates the best sequence to it: its worst value or its sum, and its
 * last link.
 *
 * Candidate c is reached by links begin[c] to begin[c + 1] from candidates `origin`, at prices
 * `price`, if they are `usable` and their worst value is at least `least`; `first` candidates have
 * none.  `own` is a candidate's value.
 */
void stiffopt_reached(int64_t bottleneck, int64_t first, int64_t count, double least,
                      const int64_t *begin, const int64_t *origin, const uint8_t *usable,
                      const double *worst, const double *price, const double *own, double *found,
                      int64_t *last) {
    for (int64_t c = 0; c < count; c++) {
        double best = c < first ? bottleneck ? INFINITY : 0.0 : -INFINITY;
        for (int64_t k = begin[c]; k < begin[c + 1]; k++) {
            if (!usable[k] || worst[k] < least) continue;
            double before = found[origin[k]];
            double came = !bottleneck ? before + price[k] : before < price[k] ? before : price[k];
            if (came > best) best = came, last[c] = k;
        }
        found[c] = !bottleneck ? best + own[c] : best < own[c] ? best : own[c];
    }
}
