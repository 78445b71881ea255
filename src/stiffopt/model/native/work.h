#ifndef STIFFOPT_WORK_H
#define STIFFOPT_WORK_H

/* Memory of the generated functions. */
typedef struct {
    const double **arg;
    double **res;
    casadi_int *iw;
    double *w;
} Work;

#define NEW_WORK(name)                                  \
    const double *name##_arg[WORK_ARG];                 \
    double *name##_res[WORK_RES], name##_w[WORK_W + 1]; \
    casadi_int name##_iw[WORK_IW + 1];                  \
    Work name = {name##_arg, name##_res, name##_iw, name##_w}

#endif
