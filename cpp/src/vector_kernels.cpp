#include "vector_kernels.hpp"

#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

namespace holdfast {

namespace isa_baseline {
extern const VectorKernels table;
}
namespace isa_avx2 {
extern const VectorKernels table;
}
namespace isa_avx512 {
extern const VectorKernels table;
}

namespace {

const VectorKernels& choose() {
    const char* wanted = std::getenv("HOLDFAST_SIMD");
    const VectorKernels* best = &isa_baseline::table;
#ifdef HOLDFAST_X86
    const VectorKernels* available[3] = {&isa_baseline::table, nullptr, nullptr};
    if (__builtin_cpu_supports("avx2")) available[1] = &isa_avx2::table;
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw")) {
        available[2] = &isa_avx512::table;
    }
    for (const VectorKernels* kernels : available) {
        if (kernels == nullptr) continue;
        best = kernels;
        if (wanted != nullptr && std::strcmp(wanted, kernels->name) == 0) return *kernels;
    }
#endif
    if (wanted != nullptr && *wanted != '\0' && std::strcmp(wanted, best->name) != 0) {
        throw std::runtime_error(std::string("HOLDFAST_SIMD=") + wanted +
                                 ": allowed here are baseline and the sets up to " + best->name);
    }
    return *best;
}

}  // namespace

const VectorKernels& vector_kernels() {
    static const VectorKernels& chosen = choose();
    return chosen;
}

void normals(const Stream& stream, std::uint64_t first, std::size_t count, double* out) {
    vector_kernels().normals(stream, first, count, out);
}

void uniforms(const Stream& stream, std::uint64_t first, std::size_t count, double* out) {
    for (std::size_t i = 0; i < count; ++i) out[i] = uniform(stream, first + i);
}

}  // namespace holdfast
