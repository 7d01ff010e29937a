// Disparity of one stereo pair, from the graph of a bundle, in ONNX Runtime's C++ API.
//
//   stereo MODEL.onnx LEFT.ppm RIGHT.ppm DISPARITY.pfm [THREADS]

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

// As `input` in deployment.json says: RGB bytes to 0 ... 1, less the mean, over the deviation.
constexpr std::array<float, 3> kMean = {0.485f, 0.456f, 0.406f};
constexpr std::array<float, 3> kStd = {0.229f, 0.224f, 0.225f};
constexpr int kRuns = 20;

struct Image {
    int width = 0;
    int height = 0;
    std::vector<std::uint8_t> rgb;  // row by row, three bytes a pixel
};

Image read_ppm(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::string magic;
    int most = 0;
    Image image;
    file >> magic >> image.width >> image.height >> most;
    file.get();  // the one blank behind the head
    if (!file || magic != "P6" || most != 255 || image.width < 1 || image.height < 1) {
        throw std::runtime_error(path + " is no binary PPM of 8 bits");
    }
    image.rgb.resize(std::size_t{3} * image.width * image.height);
    file.read(reinterpret_cast<char*>(image.rgb.data()),
              static_cast<std::streamsize>(image.rgb.size()));
    if (!file) {
        throw std::runtime_error(path + " ends too early");
    }
    return image;
}

// Normalised, channels first, zeros at the right and at the bottom up to (1, 3, height, width).
std::vector<float> prepared(const Image& image, int height, int width) {
    std::vector<float> tensor(std::size_t{3} * height * width, 0.0f);
    for (int channel = 0; channel < 3; ++channel) {
        for (int y = 0; y < image.height; ++y) {
            const std::uint8_t* row = &image.rgb[std::size_t{3} * y * image.width];
            float* into = &tensor[(std::size_t(channel) * height + y) * width];
            for (int x = 0; x < image.width; ++x) {
                into[x] = (row[3 * x + channel] / 255.0f - kMean[channel]) / kStd[channel];
            }
        }
    }
    return tensor;
}

// Rows from the bottom up; the negative scale says little endian, as this machine has it.
void write_pfm(const std::string& path, const float* map, int stride, const Image& size) {
    std::ofstream file(path, std::ios::binary);
    file << "Pf\n" << size.width << ' ' << size.height << "\n-1.0\n";
    for (int y = size.height - 1; y >= 0; --y) {
        file.write(reinterpret_cast<const char*>(map + std::size_t(y) * stride),
                   static_cast<std::streamsize>(sizeof(float)) * size.width);
    }
    if (!file.flush()) {
        throw std::runtime_error("cannot write " + path);
    }
}

class Network {
public:
    Network(const std::string& path, int threads) {
        Ort::SessionOptions options;
        options.SetIntraOpNumThreads(threads);
        options.SetGraphOptimizationLevel(GraphOptimizationLevel::ORT_ENABLE_ALL);
        session_ = Ort::Session(environment_, path.c_str(), options);
        shape_ = session_.GetInputTypeInfo(0).GetTensorTypeAndShapeInfo().GetShape();
    }

    int height() const { return static_cast<int>(shape_.at(2)); }
    int width() const { return static_cast<int>(shape_.at(3)); }

    // (1, height, width), in pixels. Add "semantic" to the outputs for class ids, int32.
    Ort::Value disparity(std::vector<float>& left, std::vector<float>& right) {
        const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
        const std::array<const char*, 2> inputs = {"left", "right"};
        const std::array<const char*, 1> outputs = {"disparity"};
        const std::array<Ort::Value, 2> pair = {tensor(memory, left), tensor(memory, right)};
        auto found = session_.Run(Ort::RunOptions{}, inputs.data(), pair.data(), pair.size(),
                                  outputs.data(), outputs.size());
        return std::move(found.front());
    }

private:
    Ort::Value tensor(const Ort::MemoryInfo& memory, std::vector<float>& values) const {
        return Ort::Value::CreateTensor<float>(memory, values.data(), values.size(), shape_.data(),
                                               shape_.size());
    }

    Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR, "stereo"};
    Ort::Session session_{nullptr};
    std::vector<std::int64_t> shape_;
};

void require_fit(const Image& left, const Image& right, const Network& network) {
    const bool equal = left.width == right.width && left.height == right.height;
    // Less than one multiple of 32 is padding.
    const int across = network.width() - left.width;
    const int down = network.height() - left.height;
    if (!equal || across < 0 || across >= 32 || down < 0 || down >= 32) {
        throw std::runtime_error("the images must be of one size that pads to " +
                                 std::to_string(network.width()) + "x" +
                                 std::to_string(network.height()));
    }
}

double median_ms(Network& network, std::vector<float>& left, std::vector<float>& right) {
    std::vector<double> times;
    for (int run = 0; run < kRuns; ++run) {
        const auto before = std::chrono::steady_clock::now();
        network.disparity(left, right);
        const std::chrono::duration<double, std::milli> took =
            std::chrono::steady_clock::now() - before;
        times.push_back(took.count());
    }
    std::nth_element(times.begin(), times.begin() + kRuns / 2, times.end());
    return times[kRuns / 2];
}

void run(const std::vector<std::string>& words) {
    const int threads = words.size() > 5 ? std::stoi(words[5]) : 0;  // 0: as many as there are cores
    Network network(words[1], threads);
    const Image left = read_ppm(words[2]);
    const Image right = read_ppm(words[3]);
    require_fit(left, right, network);
    auto left_tensor = prepared(left, network.height(), network.width());
    auto right_tensor = prepared(right, network.height(), network.width());
    const Ort::Value disparity = network.disparity(left_tensor, right_tensor);
    write_pfm(words[4], disparity.GetTensorData<float>(), network.width(), left);
    const double ms = median_ms(network, left_tensor, right_tensor);
    std::printf("%.2f ms, %.1f FPS, median of %d runs\n", ms, 1000 / ms, kRuns);
}

}  // namespace

int main(int count, char** words) {
    if (count < 5 || count > 6) {
        std::fprintf(stderr, "usage: stereo MODEL.onnx LEFT.ppm RIGHT.ppm DISPARITY.pfm [THREADS]\n");
        return 2;
    }
    try {
        run(std::vector<std::string>(words, words + count));
    } catch (const std::exception& error) {
        std::fprintf(stderr, "stereo: %s\n", error.what());
        return 1;
    }
    return 0;
}
