/* [values, name, units, shape] = fhash_read(path, number, step, region)
 *
 * A function of MATLAB and Octave: values (x, y, z) of a region [z0 z1 y0 y1 x0 x1] of variable `number`, from 0, at a
 * step, from 0; an empty region is the whole domain, and the shape is that of the variable: steps, z, y, x.
 *     mex fhash_read.c -I... -L... -lfhash        mkoctfile --mex fhash_read.c -I... -L... -lfhash */
#include <fhash.h>
#include <mex.h>

void mexFunction(int outputs, mxArray* output[], int inputs, const mxArray* input[]) {
    char path[4096];
    fhash_error error = {0};
    fhash_file* file = NULL;
    fhash_variable variable;
    variable.size = sizeof variable;
    if (inputs != 4 || outputs > 4 || mxGetString(input[0], path, sizeof path)) {
        mexErrMsgIdAndTxt("fhash:usage", "fhash_read(path, number, step, region)");
    }
    const int32_t number = (int32_t)mxGetScalar(input[1]);
    fhash_context* context = fhash_context_create(0, 2);
    if (fhash_open_path(context, path, &file, &error) == FHASH_OK &&
        fhash_variable_get(file, number, &variable, &error) == FHASH_OK) {
        int64_t region[6] = {0, variable.shape[1], 0, variable.shape[2], 0, variable.shape[3]};
        for (int i = 0; i < 6 && mxGetNumberOfElements(input[3]) == 6; i++) {
            region[i] = (int64_t)mxGetPr(input[3])[i];
        }
        mwSize lengths[3]; /* the first index varies fastest: x, y, z */
        for (int i = 0; i < 3; i++) {
            const int64_t n = region[5 - 2 * i] - region[4 - 2 * i];
            lengths[i] = n > 0 ? (mwSize)n : 0; /* the library refuses what is no region */
        }
        output[0] = mxCreateNumericArray(3, lengths, mxDOUBLE_CLASS, mxREAL);
        fhash_read(file, number, mxGetScalar(input[2]), region, 0, FHASH_FLOAT64,
                   mxGetPr(output[0]), &error);
        if (outputs > 1) output[1] = mxCreateString(variable.name);
        if (outputs > 2) output[2] = mxCreateString(variable.units);
        if (outputs > 3) output[3] = mxCreateDoubleMatrix(1, 4, mxREAL);
        for (int i = 0; i < 4 && outputs > 3; i++) {
            mxGetPr(output[3])[i] = (double)variable.shape[i];
        }
    }
    if (file) fhash_close(file);
    fhash_context_destroy(context);
    if (error.status) mexErrMsgIdAndTxt("fhash:read", "%s", error.text);
}
