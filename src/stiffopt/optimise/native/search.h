/* The global search: samples near the target, brought to the pose, and down from the best. */
#ifndef STIFFOPT_SEARCH_H
#define STIFFOPT_SEARCH_H

#include "descend.h"

typedef struct {
    int64_t tried;    /* samples that were brought towards the pose */
    int64_t reached;  /* of them came to it */
    int64_t descents; /* that converged */
    int64_t agreeing; /* of them ended at the best */
    int64_t optima;   /* distinct ones */
    int64_t complete; /* whether the last descents found nothing new */
    int64_t iterations;
} Found;

typedef struct {
    double value;
    int64_t index;
} Ranked;

/* Keep the smallest of many values in a heap whose root is the largest of them. */
static void keep_smallest(Ranked *heap, int64_t *count, int64_t most, Ranked item) {
    int64_t hole;
    if (*count < most) {
        for (hole = (*count)++; hole > 0 && heap[(hole - 1) / 2].value < item.value;
             hole = (hole - 1) / 2)
            heap[hole] = heap[(hole - 1) / 2];
    } else {
        if (!(item.value < heap[0].value)) return;
        for (hole = 0; 2 * hole + 1 < most;) {
            int64_t child = 2 * hole + 1;
            if (child + 1 < most && heap[child + 1].value > heap[child].value) child++;
            if (heap[child].value <= item.value) break;
            heap[hole] = heap[child];
            hole = child;
        }
    }
    heap[hole] = item;
}

static void sort_ranked(Ranked *items, int64_t count) {
    for (int64_t i = 1; i < count; i++) {
        Ranked item = items[i];
        int64_t k = i;
        for (; k > 0 && (items[k - 1].value > item.value ||
                         (items[k - 1].value == item.value && items[k - 1].index > item.index));
             k--)
            items[k] = items[k - 1];
        items[k] = item;
    }
}

/* Samples whose tip is nearest to the target, the nearest first.
 *
 * P->near holds weights (3) and wanted position (3), a factor a, an offset b and a matrix M (9):
 * the distance is |weights * (position - wanted)| + a sqrt(b - <M, rotation>).
 */
static int64_t nearest_samples(const Program *P, Ranked *nearest) {
    const Setup *s = P->setup;
    const double *weight = P->near, *wanted = P->near + 3, *M = P->near + 8;
    double factor = P->near[6], offset = P->near[7];
    int64_t count = 0;
    for (int64_t i = 0; i < s->samples; i++) {
        const double *pose = s->sample_poses + 12 * i;
        double sum = 0;
        for (int k = 0; k < 3; k++) {
            double each = weight[k] * (pose[k] - wanted[k]);
            sum += each * each;
        }
        sum = sqrt(sum);
        if (factor > 0) sum += factor * sqrt(fmax(0, offset - dot(M, pose + 3, 9)));
        keep_smallest(nearest, &count, s->nearest, (Ranked){sum, i});
    }
    sort_ranked(nearest, count);
    return count;
}

static int same(const Setup *s, const Descent *a, const Descent *b) {
    return fabs(a->value - b->value) < s->same && fabs(a->violation - b->violation) < s->same;
}

static int better(const Setup *s, const Descent *a, const Descent *b) {
    if (fabs(a->violation - b->violation) > s->floor_slack) return a->violation < b->violation;
    return a->value < b->value;
}

/* Best local optimum; 0 where no sample came to the pose or no descent converged. */
static int search(Program *P, Point *best, Descent *end, Found *found) {
    const Setup *s = P->setup;
    int64_t size = point_size(s), ranked = 0;
    Ranked nearest[s->nearest], screened[s->screened];
    double memory[s->screened * size];
    int64_t count = nearest_samples(P, nearest);
    memset(found, 0, sizeof *found);
    for (int64_t i = 0; i < count && ranked < s->screened; i++) {
        Point p = point_in(s, memory + ranked * size);
        memcpy(p.x, s->sample_x + nearest[i].index * s->n, (size_t)s->n * sizeof(double));
        for (int64_t k = 0; k < s->n; k++) p.x[k] = clip(p.x[k], P->lower[k], P->upper[k]);
        if (s->state)
            memcpy(p.state, s->sample_states + nearest[i].index * s->state,
                   (size_t)s->state * sizeof(double));
        found->tried++;
        if (!reach(P, &p, 20) || !evaluate(P, &p, 1)) continue;
        screened[ranked] = (Ranked){objective(s, &p) + 10 * violation(P, &p), ranked};
        ranked++;
    }
    found->reached = ranked;
    sort_ranked(screened, ranked);
    double apart = 0;
    for (int64_t k = 0; k < s->n; k++) {
        double range = P->upper[k] - P->lower[k];
        apart += 0.04 * range * range;
    }
    /* in the order of their rank, first those unlike each other, then the others */
    int64_t used[s->screened], order[s->screened], given = 0;
    memset(used, 0, sizeof used);
    for (int pass = 0; pass < 2; pass++)
        for (int64_t i = 0; i < ranked; i++) {
            if (used[i]) continue;
            const double *x = memory + screened[i].index * size;
            int alone = 1;
            for (int64_t j = 0; pass == 0 && alone && j < given; j++) {
                const double *other = memory + screened[order[j]].index * size;
                double sum = 0;
                for (int64_t k = 0; k < s->n; k++) sum += (x[k] - other[k]) * (x[k] - other[k]);
                alone = sum > apart;
            }
            if (alone) used[i] = 1, order[given++] = i;
        }
    Descent ends[s->screened], optima[s->screened];
    double optimal_x[s->screened * s->n];
    Known known = {0, optima, optimal_x};
    int64_t nothing_new = 0;
    NEW_POINT(p, s);
    for (int64_t i = 0; i < given && i < s->most_descents; i++) {
        Point from = point_in(s, memory + screened[order[i]].index * size);
        copy_point(s, &from, &p);
        measure_balls(P, &p);
        Descent now = descend(P, &p, &known);
        found->iterations += now.iterations;
        if (!now.converged || !isfinite(now.value)) continue;
        int is_new = 1;
        for (int64_t k = 0; k < found->descents && is_new; k++) is_new = !same(s, &now, ends + k);
        if (is_new) {
            memcpy(optimal_x + known.count * s->n, p.x, (size_t)s->n * sizeof(double));
            optima[known.count++] = now;
        }
        nothing_new = is_new ? 0 : nothing_new + 1;
        if (!found->descents || better(s, &now, end)) {
            *end = now;
            copy_point(s, &p, best);
        }
        ends[found->descents++] = now;
        if (nothing_new >= s->agreeing) {
            found->complete = 1;
            break;
        }
    }
    found->optima = known.count;
    for (int64_t k = 0; k < found->descents; k++) found->agreeing += same(s, ends + k, end);
    return found->descents > 0;
}

#endif
