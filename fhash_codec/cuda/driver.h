// What Python calls of NVRTC and of CUDA's driver, as NVIDIA's headers have it: it takes its
// declarations from this text (setup.py). Results are 0 for success.

typedef struct _nvrtcProgram* nvrtcProgram;
int nvrtcVersion(int* major, int* minor);
int nvrtcGetNumSupportedArchs(int* count);
int nvrtcGetSupportedArchs(int* architectures);
int nvrtcCreateProgram(nvrtcProgram* program, const char* text, const char* name, int headers,
                       const char* const* texts, const char* const* names);
int nvrtcCompileProgram(nvrtcProgram program, int count, const char* const* options);
int nvrtcGetProgramLogSize(nvrtcProgram program, size_t* size);
int nvrtcGetProgramLog(nvrtcProgram program, char* log);
int nvrtcGetCUBINSize(nvrtcProgram program, size_t* size);
int nvrtcGetCUBIN(nvrtcProgram program, char* code);
int nvrtcDestroyProgram(nvrtcProgram* program);
const char* nvrtcGetErrorString(int result);

typedef struct CUmod_st* CUmodule;
typedef struct CUfunc_st* CUfunction;
typedef struct CUstream_st* CUstream;
int cuInit(unsigned flags);
int cuDriverGetVersion(int* version);
int cuGetErrorString(int result, const char** text);
int cuDeviceGetAttribute(int* value, int attribute, int device);
int cuModuleLoadData(CUmodule* module, const void* image);
int cuModuleGetFunction(CUfunction* function, CUmodule module, const char* name);
int cuFuncSetAttribute(CUfunction function, int attribute, int value);
int cuLaunchKernel(CUfunction function, unsigned grid_x, unsigned grid_y, unsigned grid_z,
                   unsigned block_x, unsigned block_y, unsigned block_z, unsigned shared_bytes,
                   CUstream stream, void** parameters, void** extra);
typedef struct CUctx_st* CUcontext;
typedef unsigned long long CUdeviceptr;
int cuDeviceGetCount(int* count);
int cuDeviceGetName(char* name, int length, int device);
int cuDevicePrimaryCtxRetain(CUcontext* context, int device);
int cuCtxPushCurrent_v2(CUcontext context);
int cuCtxPopCurrent_v2(CUcontext* context);
int cuCtxSynchronize(void);
int cuMemGetInfo_v2(size_t* free, size_t* total);
int cuMemAlloc_v2(CUdeviceptr* address, size_t bytes);
int cuMemFree_v2(CUdeviceptr address);
int cuMemcpyHtoD_v2(CUdeviceptr to, const void* from, size_t bytes);
int cuMemcpyDtoH_v2(void* to, CUdeviceptr from, size_t bytes);
int cuMemsetD8_v2(CUdeviceptr to, unsigned char value, size_t bytes);
