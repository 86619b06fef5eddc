#include "sensing.hpp"

#include <cmath>
#include <vector>

#include "deterministic_math.hpp"
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

        std::vector<std::int64_t> particle(input.samples);
        stratified(input.weights, input.count, input.samples, input.stream, particle.data());
        const Stream noise_stream = substream(input.stream, 1);
        std::vector<double> noise(input.samples * largest);
        normals(noise_stream, 0, noise.size(), noise.data());
        observations_.resize(total * input.samples);
        for (std::size_t j = 0; j < input.sensing_actions; ++j) {
            for (std::size_t i = 0; i < input.samples; ++i) {
                for (std::size_t c = 0; c < input.observation_size[j]; ++c) {
                    const std::size_t row = first_coordinate_[j] + c;
                    const auto own = static_cast<std::size_t>(particle[i]);
                    const double variance = input.varying_variance
                                                ? input.variance[row * input.count + own]
                                                : input.variance[row];
                    observations_[first_coordinate_[j] * input.samples +
                                  i * input.observation_size[j] + c] =
                        input.predicted[row * input.count + own] +
                        std::sqrt(variance) * noise[i * largest + c];
                }
            }
        }
    }

    /// Weights of posterior `index` = j * M + i.
    std::size_t operator()(std::size_t index, double* weights) const {
        const std::size_t j = index / input_.samples, i = index % input_.samples;
        const std::size_t row = first_coordinate_[j], size = input_.observation_size[j];
        const std::size_t variance_row = input_.varying_variance ? row * input_.count : row;
        const double* observation = observations_.data() + row * input_.samples + i * size;
        const double* predicted = input_.predicted + row * input_.count;
        std::vector<double> turned;
        if (input_.circular != nullptr) {
            turned = nearest_turns(predicted, observation, size, input_.circular + row);
            predicted = turned.data();
        }
        return vector_kernels().posterior(
            {input_.count, log_weights_.data(), size, predicted,
             inverse_variance_.data() + variance_row,
             input_.varying_variance ? log_normalizer_.data() + j * input_.count : nullptr,
             observation, input_.drop_negligible},
            weights);
    }

    /// Weights of the belief as it is.
    std::size_t belief(double* weights) const {
        return vector_kernels().normalize(log_weights_.data(), input_.count, input_.drop_negligible,
                                          weights);
    }

  private:
    /// The predictions, of angles as many turns further as brings them nearest to the observation.
    std::vector<double> nearest_turns(const double* predicted, const double* observation,
                                      std::size_t size, const std::uint8_t* circular) const {
        std::vector<double> turned(predicted, predicted + size * input_.count);
        for (std::size_t c = 0; c < size; ++c) {
            if (circular[c] == 0) continue;
            for (std::size_t n = 0; n < input_.count; ++n) {
                double& angle = turned[c * input_.count + n];
                angle = observation[c] - wrapped(observation[c] - angle);
            }
        }
        return turned;
    }

    const HypothesisInput& input_;
    std::vector<double> log_weights_;
    std::vector<std::size_t> first_coordinate_;
    std::vector<double> inverse_variance_, log_normalizer_, observations_;
};

}  // namespace

void hypothetical_entropies(const HypothesisInput& input, const PointSets& sets,
                            const EntropySettings& settings, bool unchanged, double* out,
                            EntropyCounts& counts) {
    const Hypotheses hypotheses(input);
    const std::size_t posteriors = input.sensing_actions * input.samples;
    entropies(
        sets, posteriors + (unchanged ? 1 : 0),
        [&](std::size_t index, double* weights) {
            return index < posteriors ? hypotheses(index, weights) : hypotheses.belief(weights);
        },
        settings, out, counts);
}

void stratified(const double* weights, std::size_t count, std::size_t samples, const Stream& stream,
                std::int64_t* particles) {
    double cumulated = 0.0;
    std::size_t n = 0, last_with_weight = 0;
    for (std::size_t i = 0; i < samples; ++i) {
        const double at =
            (static_cast<double>(i) + uniform(stream, i)) / static_cast<double>(samples);
        while (n < count && cumulated + weights[n] <= at) {
            if (weights[n] > 0.0) last_with_weight = n;
            cumulated += weights[n++];
        }
        // Rounding can leave the total a little below `at`; then the last particle with weight is
        // meant.
        particles[i] = static_cast<std::int64_t>(n < count ? n : last_with_weight);
    }
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
