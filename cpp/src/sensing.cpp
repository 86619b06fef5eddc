#include "sensing.hpp"

#include <cmath>
#include <vector>

#include "vector_kernels.hpp"

namespace holdfast {

namespace {

/// The hypothetical observations and all that their posteriors share.
class Hypotheses {
  public:
    explicit Hypotheses(const HypothesisInput& input) : input_(input), log_weights_(input.count) {
        const VectorKernels& kernels = vector_kernels();
        kernels.log(input.weights, log_weights_.data(), input.count);
        std::size_t total = 0, largest = 0;
        for (std::size_t j = 0; j < input.sensing_actions; ++j) {
            first_coordinate_.push_back(total);
            total += input.observation_size[j];
            if (input.observation_size[j] > largest) largest = input.observation_size[j];
        }
        first_coordinate_.push_back(total);

        const std::size_t variances = input.varying_variance ? total * input.count : total;
        inverse_variance_.resize(variances);
        for (std::size_t i = 0; i < variances; ++i) inverse_variance_[i] = 1.0 / input.variance[i];
        if (input.varying_variance) {
            log_normalizer_.resize(input.sensing_actions * input.count);
            std::vector<double> log_variance(total * input.count);
            kernels.log(input.variance, log_variance.data(), total * input.count);
            for (std::size_t j = 0; j < input.sensing_actions; ++j) {
                for (std::size_t c = first_coordinate_[j]; c < first_coordinate_[j + 1]; ++c) {
                    for (std::size_t n = 0; n < input.count; ++n) {
                        log_normalizer_[j * input.count + n] +=
                            0.5 * log_variance[c * input.count + n];
                    }
                }
            }
        }

        // Stratified: sample i lies in [i, i + 1) / M of the cumulated weight.
        std::vector<std::size_t> particle(input.samples);
        double cumulated = 0.0;
        std::size_t n = 0, last_with_weight = 0;
        for (std::size_t i = 0; i < input.samples; ++i) {
            const double at = (static_cast<double>(i) + uniform(input.stream, i)) /
                              static_cast<double>(input.samples);
            while (n < input.count && cumulated + input.weights[n] <= at) {
                if (input.weights[n] > 0.0) last_with_weight = n;
                cumulated += input.weights[n++];
            }
            // Rounding can leave the total a little below `at`; then the last particle with weight
            // is meant.
            particle[i] = n < input.count ? n : last_with_weight;
        }
        const Stream noise_stream = substream(input.stream, 1);
        std::vector<double> noise(input.samples * largest);
        normals(noise_stream, 0, noise.size(), noise.data());
        observations_.resize(total * input.samples);
        for (std::size_t j = 0; j < input.sensing_actions; ++j) {
            for (std::size_t i = 0; i < input.samples; ++i) {
                for (std::size_t c = 0; c < input.observation_size[j]; ++c) {
                    const std::size_t row = first_coordinate_[j] + c;
                    const double variance = input.varying_variance
                                                ? input.variance[row * input.count + particle[i]]
                                                : input.variance[row];
                    observations_[first_coordinate_[j] * input.samples +
                                  i * input.observation_size[j] + c] =
                        input.predicted[row * input.count + particle[i]] +
                        std::sqrt(variance) * noise[i * largest + c];
                }
            }
        }
    }

    /// Weights of posterior `index` = j * M + i.
    std::size_t operator()(std::size_t index, double* weights) const {
        const std::size_t j = index / input_.samples, i = index % input_.samples;
        const std::size_t row = first_coordinate_[j];
        const std::size_t variance_row = input_.varying_variance ? row * input_.count : row;
        return vector_kernels().posterior(
            {input_.count, log_weights_.data(), input_.observation_size[j],
             input_.predicted + row * input_.count, inverse_variance_.data() + variance_row,
             input_.varying_variance ? log_normalizer_.data() + j * input_.count : nullptr,
             observations_.data() + row * input_.samples + i * input_.observation_size[j],
             input_.drop_negligible, input_.circular == nullptr ? nullptr : input_.circular + row},
            weights);
    }

  private:
    const HypothesisInput& input_;
    std::vector<double> log_weights_;
    std::vector<std::size_t> first_coordinate_;
    std::vector<double> inverse_variance_, log_normalizer_, observations_;
};

}  // namespace

void hypothetical_entropies(const HypothesisInput& input, const PointSets& sets,
                            const EntropySettings& settings, double* out, EntropyCounts& counts) {
    const Hypotheses hypotheses(input);
    entropies(
        sets, input.sensing_actions * input.samples,
        [&](std::size_t index, double* weights) { return hypotheses(index, weights); }, settings,
        out, counts);
}

void hypothetical_weights(const HypothesisInput& input, double* out) {
    const Hypotheses hypotheses(input);
    for (std::size_t index = 0; index < input.sensing_actions * input.samples; ++index) {
        if (hypotheses(index, out + index * input.count) == 0) {
            for (std::size_t n = 0; n < input.count; ++n) {
                out[index * input.count + n] = std::nan("");
            }
        }
    }
}

}  // namespace holdfast
