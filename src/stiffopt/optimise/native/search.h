/* The global search: bring samples near the target to the pose, then descend from the best. */
#ifndef STIFFOPT_SEARCH_H
#define STIFFOPT_SEARCH_H

#include "descend.h"

typedef struct {
    int64_t tried;    /* samples that were brought towards the pose */
    int64_t reached;  /* samples that reached it */
    int64_t descents; /* descents that converged */
    int64_t agreeing; /* descents that ended at the best optimum */
    int64_t optima;   /* distinct optima */
    int64_t complete; /* whether the last descents found nothing new */
    int64_t iterations;
} Found;

typedef struct {
    double value;
    int64_t index;
} Ranked;

/* Keep the smallest `capacity` of many values, in a heap whose root is the largest of them. */
static void keep_smallest(Ranked *heap, int64_t *count, int64_t capacity, Ranked item) {
    int64_t hole;
    if (*count < capacity) {
        for (hole = (*count)++; hole > 0 && heap[(hole - 1) / 2].value < item.value;
             hole = (hole - 1) / 2)
            heap[hole] = heap[(hole - 1) / 2];
    } else {
        if (!(item.value < heap[0].value)) return;
        for (hole = 0; 2 * hole + 1 < capacity;) {
            int64_t child = 2 * hole + 1;
            if (child + 1 < capacity && heap[child + 1].value > heap[child].value) child++;
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

/* Add to `total` how far the tips of all samples are from meeting a term; see `Nearness` in
 * term.py. */
static void add_nearness(const Setup *s, const double *near, double *total) {
    const double a = near[0], bx = near[1], by = near[2], bz = near[3];
    const double cx = near[4], cy = near[5], cz = near[6], limit = near[17];
    const int turns = largest(near + 7, 9) > 0, is_root = near[16] != 0;
    const double *pose = s->sample_poses;
    for (int64_t i = 0; i < s->samples; i++, pose += 12) {
        const double x = pose[0], y = pose[1], z = pose[2];
        double value = a + x * (bx + cx * x) + y * (by + cy * y) + z * (bz + cz * z);
        if (turns) value += dot(near + 7, pose + 3, 9);
        if (value < 0) value = 0; /* faster than a call of fmax for each sample */
        value = (is_root ? sqrt(value) : value) - limit;
        if (value > 0) total[i] += value;
    }
}

/* Find the samples nearest to the target, in order, and the effort of the search, which grows with
 * the share of samples that meet the target. */
static int64_t nearest_samples(Program *P, Ranked *nearest, Effort *effort) {
    const Setup *s = P->setup;
    const Effort *least = &s->least_effort, *most = &s->most_effort;
    int64_t count = 0, covered = 0, kept;
    double distances[s->samples];
    memset(distances, 0, sizeof distances);
    for (int64_t k = 0; k < s->near; k++) add_nearness(s, P->near + 18 * k, distances);
    for (int64_t i = 0; i < s->samples; i++) covered += distances[i] == 0;
    double share = fmin(1, (double)covered / (double)s->samples / s->covered);
    effort->screened = least->screened + (int64_t)(share * (double)(most->screened - least->screened));
    effort->agreeing = least->agreeing + (int64_t)(share * (double)(most->agreeing - least->agreeing));
    effort->most_descents = least->most_descents +
        (int64_t)(share * (double)(most->most_descents - least->most_descents));
    kept = 2 * (s->state ? most : effort)->screened; /* under load few samples reach the target */
    kept = kept < s->samples ? kept : s->samples;
    for (int64_t i = 0; i < s->samples; i++)
        if (count < kept || distances[i] < nearest[0].value)
            keep_smallest(nearest, &count, kept, (Ranked){distances[i], i});
    sort_ranked(nearest, count);
    return count;
}

/* Set a point to the pressures and the equilibrium of a sample. */
static void start_from_sample(const Program *P, int64_t index, Point *p) {
    const Setup *s = P->setup;
    const double *x = s->sample_x + index * s->n;
    for (int64_t k = 0; k < s->n; k++) p->x[k] = clip(x[k], P->lower[k], P->upper[k]);
    if (s->state)
        memcpy(p->state, s->sample_states + index * s->state, (size_t)s->state * sizeof(double));
}

static int same(const Setup *s, const Descent *a, const Descent *b) {
    return fabs(a->value - b->value) < s->same_optimum && fabs(a->violation - b->violation) < s->same_optimum;
}

static int better(const Setup *s, const Descent *a, const Descent *b) {
    if (fabs(a->violation - b->violation) > 0.5 * s->descent.floor_margin) return a->violation < b->violation;
    return a->value < b->value;
}

/* Return whether one of the `tries` samples nearest to the target can be brought to it, as p. */
static int can_reach(Program *P, Point *p, int64_t tries) {
    const Setup *s = P->setup;
    Effort effort;
    Ranked nearest[2 * s->most_effort.screened];
    int64_t count = nearest_samples(P, nearest, &effort);
    for (int64_t i = 0; i < count && i < tries; i++) {
        start_from_sample(P, nearest[i].index, p);
        if (reach(P, p, s->reach.iterations_of_many)) return 1;
    }
    return 0;
}

/* Find the best local optimum; return 0 if no sample reached the pose or no descent converged. */
static int search(Program *P, Point *best, Descent *end, Found *found) {
    const Setup *s = P->setup;
    int64_t size = point_size(s), ranked = 0;
    Effort effort;
    Ranked nearest[2 * s->most_effort.screened];
    int64_t count = nearest_samples(P, nearest, &effort);
    Ranked screened[effort.screened];
    double *memory = malloc((size_t)(effort.screened * size) * sizeof(double));
    if (!memory) return 0;
    memset(found, 0, sizeof *found);
    for (int64_t i = 0; i < count && ranked < effort.screened && !stopped(P); i++) {
        Point p = point_in(s, memory + ranked * size);
        start_from_sample(P, nearest[i].index, &p);
        found->tried++;
        if (!reach_blindly(P, &p, s->reach.iterations_of_many)) continue;
        if (!evaluate_by_sight(P, &p, ROUGH)) continue;
        double value = objective(s, &p) + s->price_of_floors * violation(P, &p);
        screened[ranked] = (Ranked){value + s->price_of_obstacles * intrusion(P, &p), ranked};
        ranked++;
    }
    found->reached = ranked;
    sort_ranked(screened, ranked);
    double spacing = 0; /* squared */
    for (int64_t k = 0; k < s->n; k++) {
        double range = P->upper[k] - P->lower[k];
        spacing += s->unlike * s->unlike * range * range;
    }
    /* sort by rank, those unlike each other first */
    int64_t used[effort.screened], order[effort.screened], given = 0;
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
                alone = sum > spacing;
            }
            if (alone) used[i] = 1, order[given++] = i;
        }
    Descent ends[effort.screened], optima[effort.screened];
    double optimal_x[effort.screened * s->n];
    Known known = {0, optima, optimal_x};
    int64_t nothing_new = 0;
    NEW_POINT(p, s);
    for (int64_t i = 0; i < given && i < effort.most_descents && !(i && stopped(P)); i++) {
        Point from = point_in(s, memory + screened[order[i]].index * size);
        copy_point(s, &from, &p);
        if (s->obstacles && !evaluate(P, &p, 1)) continue; /* its obstacles were evaluated roughly */
        measure_balls(P, &p);
        if (!p.reached && !(reach(P, &p, s->reach.iterations_of_many) && evaluate(P, &p, 1))) continue;
        Descent now = descend(P, &p, &known);
        found->iterations += now.iterations;
        /* a stopped descent is at the pose, so its end can be used */
        if (!(now.converged || stopped(P)) || !isfinite(now.value)) continue;
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
        if (nothing_new >= effort.agreeing) {
            found->complete = 1;
            break;
        }
    }
    found->optima = known.count;
    for (int64_t k = 0; k < found->descents; k++) found->agreeing += same(s, ends + k, end);
    free(memory);
    return found->descents > 0;
}

#endif
