/* FMI 2.0 for co-simulation around the plant; the first lines of plant.c name what the importer may ask for. */

#include <stddef.h>
#include "plant.c"

typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef char fmi2Char, fmi2Byte;
typedef const fmi2Char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

#define PASTED(a, b) a##b
#define PASTE(a, b) PASTED(a, b)
#ifdef FMI2_FUNCTION_PREFIX
#define NAMED(name) PASTE(FMI2_FUNCTION_PREFIX, name)
#else
#define NAMED(name) name
#endif
#if defined _WIN32
#define FMI(kind, name) __declspec(dllexport) kind NAMED(name)
#elif defined __GNUC__
#define FMI(kind, name) __attribute__((visibility("default"))) kind NAMED(name)
#else
#define FMI(kind, name) kind NAMED(name)
#endif
/* A prototype beside each definition, as strict compilers ask for. */
#define STATUS(name, ...) \
    FMI(fmi2Status, name)(__VA_ARGS__); \
    fmi2Status NAMED(name)(__VA_ARGS__)

#define PARAMETERS (sizeof(struct plant_parameters) / sizeof(double))
#define INPUTS (PLANT_INPUTS + PLANT_DISTURBANCES)

static const double least[PARAMETERS] = {PLANT_LEAST};

enum phase { STARTED, INITIALISING, RUNNING, ENDED, FAILED };
struct state {
    struct plant plant;
    double input[INPUTS];
    enum phase phase;
};
struct instance {
    struct state state;
    const fmi2CallbackFunctions *calls;
    char name[64];
};

static fmi2Status failed(struct instance *of, const char *why)
{
    if (of->calls->logger != NULL)
        of->calls->logger(of->calls->componentEnvironment, of->name, fmi2Error, "error", "%s", why);
    return fmi2Error;
}

static void restart(struct state *s, const struct plant_parameters *p)
{
    plant_reset(&s->plant, p);
    s->phase = STARTED;
    memset(s->input, 0, sizeof s->input);
}

FMI(fmi2String, fmi2GetTypesPlatform)(void);
fmi2String NAMED(fmi2GetTypesPlatform)(void)
{
    return "default";
}

FMI(fmi2String, fmi2GetVersion)(void);
fmi2String NAMED(fmi2GetVersion)(void)
{
    return "2.0";
}

FMI(fmi2Component, fmi2Instantiate)(fmi2String, fmi2Type, fmi2String, fmi2String, const fmi2CallbackFunctions *,
                                    fmi2Boolean, fmi2Boolean);
fmi2Component NAMED(fmi2Instantiate)(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions *calls, fmi2Boolean visible, fmi2Boolean logging)
{
    struct instance *made;

    (void)resources, (void)visible, (void)logging;
    if (calls == NULL || calls->allocateMemory == NULL || calls->freeMemory == NULL)
        return NULL;
    made = calls->allocateMemory(1, sizeof *made);
    if (made == NULL)
        return NULL;
    made->calls = calls;
    strncpy(made->name, name == NULL ? "" : name, sizeof made->name - 1);
    made->name[sizeof made->name - 1] = '\0';
    restart(&made->state, &plant_identified);
    if (type == fmi2CoSimulation && guid != NULL && strcmp(guid, PLANT_GUID) == 0)
        return made;
    failed(made, "this is for co-simulation, and the guid must be that of modelDescription.xml");
    calls->freeMemory(made);
    return NULL;
}

FMI(void, fmi2FreeInstance)(fmi2Component);
void NAMED(fmi2FreeInstance)(fmi2Component c)
{
    struct instance *of = c;
    if (of != NULL)
        of->calls->freeMemory(of);
}

STATUS(fmi2SetDebugLogging, fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

STATUS(fmi2SetupExperiment, fmi2Component c, fmi2Boolean known, fmi2Real tolerance, fmi2Real start, fmi2Boolean ends,
       fmi2Real stop)
{
    (void)c, (void)known, (void)tolerance, (void)start, (void)ends, (void)stop;
    return fmi2OK;
}

static fmi2Status passed(struct instance *of, enum phase from, enum phase to)
{
    if (of->state.phase != from)
        return failed(of, "this call does not come next");
    of->state.phase = to;
    return fmi2OK;
}

STATUS(fmi2EnterInitializationMode, fmi2Component c)
{
    return passed(c, STARTED, INITIALISING);
}

STATUS(fmi2ExitInitializationMode, fmi2Component c)
{
    return passed(c, INITIALISING, RUNNING);
}

STATUS(fmi2Terminate, fmi2Component c)
{
    return passed(c, RUNNING, ENDED);
}

STATUS(fmi2Reset, fmi2Component c)
{
    restart(&((struct instance *)c)->state, &plant_identified);
    return fmi2OK;
}

/* References count parameters, then inputs and disturbances, then outputs. */
STATUS(fmi2GetReal, fmi2Component c, const fmi2ValueReference at[], size_t n, fmi2Real values[])
{
    struct instance *of = c;
    const double *p = (const double *)&of->state.plant.p;
    double y[PLANT_OUTPUTS];
    size_t k;

    plant_outputs(&of->state.plant, y);
    for (k = 0; k < n; k++) {
        if (at[k] >= PARAMETERS + INPUTS + PLANT_OUTPUTS)
            return failed(of, "there is no variable of this reference");
        values[k] = at[k] < PARAMETERS ? p[at[k]]
                    : at[k] < PARAMETERS + INPUTS ? of->state.input[at[k] - PARAMETERS]
                                                  : y[at[k] - PARAMETERS - INPUTS];
    }
    return fmi2OK;
}

STATUS(fmi2SetReal, fmi2Component c, const fmi2ValueReference at[], size_t n, const fmi2Real values[])
{
    struct instance *of = c;
    double *p = (double *)&of->state.plant.p;
    size_t k;
    int changed = 0;

    for (k = 0; k < n; k++) {
        if (at[k] >= PARAMETERS + INPUTS || !isfinite(values[k]))
            return failed(of, "only parameters and inputs can be set, and only to finite numbers");
        if (at[k] < PARAMETERS && values[k] < least[at[k]])
            return failed(of, "a parameter is less than its min in modelDescription.xml");
    }
    for (k = 0; k < n; k++) {
        if (at[k] >= PARAMETERS) {
            of->state.input[at[k] - PARAMETERS] = values[k];
        } else {
            p[at[k]] = values[k];
            changed = 1;
        }
    }
    if (changed && of->state.phase < RUNNING) /* it begins with the parameters that it then has */
        plant_reset(&of->state.plant, &of->state.plant.p);
    return fmi2OK;
}

STATUS(fmi2DoStep, fmi2Component c, fmi2Real now, fmi2Real step, fmi2Boolean no_way_back)
{
    struct instance *of = c;
    int done;

    (void)now, (void)no_way_back;
    if (of->state.phase != RUNNING)
        return failed(of, "a step comes after the initialisation and before the end");
    done = plant_step(&of->state.plant, of->state.input, of->state.input + PLANT_INPUTS, step);
    if (done == PLANT_REFUSED)
        return failed(of, "the step is not positive, or too long, or too short for the delay of the input");
    if (done == PLANT_LOST) {
        of->state.phase = FAILED;
        return failed(of, "the rotor has left the air gap, or the numbers are no longer finite");
    }
    return fmi2OK;
}

STATUS(fmi2GetFMUstate, fmi2Component c, fmi2FMUstate *kept)
{
    struct instance *of = c;
    if (*kept == NULL)
        *kept = of->calls->allocateMemory(1, sizeof of->state);
    if (*kept == NULL)
        return failed(of, "there is no memory left");
    memcpy(*kept, &of->state, sizeof of->state);
    return fmi2OK;
}

STATUS(fmi2SetFMUstate, fmi2Component c, fmi2FMUstate kept)
{
    memcpy(&((struct instance *)c)->state, kept, sizeof(struct state));
    return fmi2OK;
}

STATUS(fmi2FreeFMUstate, fmi2Component c, fmi2FMUstate *kept)
{
    if (*kept != NULL)
        ((struct instance *)c)->calls->freeMemory(*kept);
    *kept = NULL;
    return fmi2OK;
}

STATUS(fmi2SerializedFMUstateSize, fmi2Component c, fmi2FMUstate kept, size_t *size)
{
    (void)c, (void)kept;
    *size = sizeof(struct state);
    return fmi2OK;
}

STATUS(fmi2SerializeFMUstate, fmi2Component c, fmi2FMUstate kept, fmi2Byte bytes[], size_t size)
{
    if (size < sizeof(struct state))
        return failed(c, "the state needs more bytes");
    memcpy(bytes, kept, sizeof(struct state));
    return fmi2OK;
}

STATUS(fmi2DeSerializeFMUstate, fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *kept)
{
    struct instance *of = c;
    if (size != sizeof(struct state))
        return failed(of, "these bytes are not a state of this plant");
    if (*kept == NULL)
        *kept = of->calls->allocateMemory(1, size);
    if (*kept == NULL)
        return failed(of, "there is no memory left");
    memcpy(*kept, bytes, size);
    return fmi2OK;
}

/* What there is none of: other types, derivatives, steps that take their time. */
#define NONE(kind, get, set) \
    STATUS(get, fmi2Component c, const fmi2ValueReference at[], size_t n, kind values[]) \
    { \
        (void)at, (void)values; \
        return n == 0 ? fmi2OK : failed(c, "there is no variable of this type"); \
    } \
    STATUS(set, fmi2Component c, const fmi2ValueReference at[], size_t n, const kind values[]) \
    { \
        (void)at, (void)values; \
        return n == 0 ? fmi2OK : failed(c, "there is no variable of this type"); \
    }
NONE(fmi2Integer, fmi2GetInteger, fmi2SetInteger)
NONE(fmi2Boolean, fmi2GetBoolean, fmi2SetBoolean)
NONE(fmi2String, fmi2GetString, fmi2SetString)

STATUS(fmi2GetDirectionalDerivative, fmi2Component c, const fmi2ValueReference z[], size_t n_z,
       const fmi2ValueReference v[], size_t n_v, const fmi2Real dv[], fmi2Real dz[])
{
    (void)z, (void)n_z, (void)v, (void)n_v, (void)dv, (void)dz;
    return failed(c, "there are no directional derivatives");
}

STATUS(fmi2SetRealInputDerivatives, fmi2Component c, const fmi2ValueReference at[], size_t n,
       const fmi2Integer order[], const fmi2Real values[])
{
    (void)at, (void)order, (void)values;
    return n == 0 ? fmi2OK : failed(c, "inputs are held over a step");
}

STATUS(fmi2GetRealOutputDerivatives, fmi2Component c, const fmi2ValueReference at[], size_t n,
       const fmi2Integer order[], fmi2Real values[])
{
    (void)at, (void)order, (void)values;
    return n == 0 ? fmi2OK : failed(c, "there are no derivatives of outputs");
}

STATUS(fmi2CancelStep, fmi2Component c)
{
    return failed(c, "no step takes its time");
}

#define TOLD(kind, name) \
    STATUS(name, fmi2Component c, const fmi2StatusKind what, kind *value) \
    { \
        (void)c, (void)what, (void)value; \
        return fmi2Discard; \
    }
TOLD(fmi2Status, fmi2GetStatus)
TOLD(fmi2Real, fmi2GetRealStatus)
TOLD(fmi2Integer, fmi2GetIntegerStatus)
TOLD(fmi2Boolean, fmi2GetBooleanStatus)
TOLD(fmi2String, fmi2GetStringStatus)
