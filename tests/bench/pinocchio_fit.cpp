// The same job in C++: a loop over Pinocchio's regressor, and LAPACK's QR of each joint's own columns.
//
//     pinocchio_fit DATA.bin JOINTS.txt REPEATS     prints one JSON object
//
// It does what a careful engineer would: pieces that stay in the cache, a joint's row without the links that do not
// move it, triangles instead of a matrix of all samples. Both files are written by
// tests/bench/compiled_inputs.py.

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Dense>

#include <pinocchio/multibody.hpp>

#include <pinocchio/algorithm/regressor.hpp>

extern "C" void scipy_dgeqrf_(const int* rows, const int* columns, double* a, const int* leading, double* tau,
                              double* work, const int* work_size, int* info);

namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr int kLinkParameters = 10;
constexpr int kDriveParameters = 4;  // actuator inertia, viscous and dry friction, offset
constexpr int kWidth = kLinkParameters + kDriveParameters;
constexpr int kPieceSamples = 2048;
constexpr double kDependent = 1e-8;  // of a column's norm: what is left of a dependent one

struct Measurements {
    MatrixXd position, velocity, acceleration, torque;  // shape (joints, samples)
};

MatrixXd read_matrix(std::ifstream& file, std::int64_t joints, std::int64_t samples) {
    Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> rows(joints, samples);
    file.read(reinterpret_cast<char*>(rows.data()), static_cast<std::streamsize>(rows.size() * sizeof(double)));
    if (!file) throw std::runtime_error("the file of measurements is too short");
    return rows;
}

Measurements read_measurements(const char* path) {
    std::ifstream file(path, std::ios::binary);
    std::int64_t shape[2];
    file.read(reinterpret_cast<char*>(shape), sizeof(shape));
    if (!file) throw std::runtime_error("there is no file of measurements");
    Measurements found;
    found.position = read_matrix(file, shape[0], shape[1]);
    found.velocity = read_matrix(file, shape[0], shape[1]);
    found.acceleration = read_matrix(file, shape[0], shape[1]);
    found.torque = read_matrix(file, shape[0], shape[1]);
    return found;
}

// A tree of revolute joints: for each its parent, its kind, and its placement as rotation (row by row) and position.
// The regressor does not depend on the masses.
pinocchio::Model read_model(const char* path) {
    std::ifstream file(path);
    pinocchio::Model model;
    std::size_t parent = 0;
    std::string kind;
    while (file >> parent >> kind) {
        Eigen::Matrix3d rotation;
        Eigen::Vector3d position;
        for (int row = 0; row < 3; ++row) {
            for (int column = 0; column < 3; ++column) file >> rotation(row, column);
        }
        for (int row = 0; row < 3; ++row) file >> position(row);
        const pinocchio::SE3 placement(rotation, position);
        const std::string name = "joint " + std::to_string(model.njoints);
        if (kind == "JointModelRX") {
            model.addJoint(parent, pinocchio::JointModelRX(), placement, name);
        } else if (kind == "JointModelRY") {
            model.addJoint(parent, pinocchio::JointModelRY(), placement, name);
        } else if (kind == "JointModelRZ") {
            model.addJoint(parent, pinocchio::JointModelRZ(), placement, name);
        } else {
            throw std::runtime_error("a joint of a kind that this program does not know: " + kind);
        }
    }
    if (model.nv == 0) throw std::runtime_error("there is no file of joints");
    return model;
}

// The columns of one joint's torque, and their triangle so far above the rows of a piece.
class JointTriangle {
  public:
    JointTriangle(std::vector<int> columns, int joint)
        : columns_(std::move(columns)),
          joint_(joint),
          count_(static_cast<int>(columns_.size()) + 1),
          leading_(count_ + kPieceSamples + 5),  // no power of two: columns would meet in the cache
          rows_(MatrixXd::Zero(leading_, count_)),
          scales_(count_) {
        const int query = -1;
        const int height = count_ + kPieceSamples;
        double wanted = 0.0;
        int info = 0;
        scipy_dgeqrf_(&height, &count_, rows_.data(), &leading_, scales_.data(), &wanted, &query, &info);
        work_.resize(static_cast<int>(wanted));
    }

    const std::vector<int>& columns() const { return columns_; }

    void put(int row, const MatrixXd& regressor, double velocity, double acceleration, double torque) {
        double* out = rows_.data() + count_ + row;
        const int links = count_ - 1 - kDriveParameters;
        for (int place = 0; place < links; ++place) {
            const int column = columns_[place];
            const int link = column / kWidth;
            *out = regressor(joint_, link * kLinkParameters + column % kWidth);
            out += leading_;
        }
        const double sign = velocity > 0.0 ? 1.0 : (velocity < 0.0 ? -1.0 : 0.0);
        for (const double value : {acceleration, velocity, sign, 1.0, torque}) {
            *out = value;
            out += leading_;
        }
    }

    void reduce(int samples) {
        const int height = count_ + samples;
        const int work_size = static_cast<int>(work_.size());
        int info = 0;
        scipy_dgeqrf_(&height, &count_, rows_.data(), &leading_, scales_.data(), work_.data(), &work_size, &info);
        if (info != 0) throw std::runtime_error("dgeqrf refused its arguments");
        for (int column = 0; column < count_; ++column) {
            rows_.col(column).segment(column + 1, count_ - column - 1).setZero();
        }
    }

    // The triangle in rows over all columns and the torque, shape (count, width + 1).
    MatrixXd spread(int width) const {
        MatrixXd out = MatrixXd::Zero(count_, width + 1);
        for (int place = 0; place + 1 < count_; ++place) {
            out.col(columns_[place]) = rows_.col(place).head(count_);
        }
        out.col(width) = rows_.col(count_ - 1).head(count_);
        return out;
    }

  private:
    std::vector<int> columns_;
    int joint_;
    int count_;
    int leading_;
    MatrixXd rows_;
    VectorXd scales_;
    VectorXd work_;
};

struct Fit {
    long base_parameters;
    double residual_norm;
};

std::vector<JointTriangle> triangles_of(const pinocchio::Model& model) {
    std::vector<JointTriangle> found;
    for (int joint = 0; joint < model.nv; ++joint) {
        std::vector<int> columns;
        for (const auto link : model.subtrees[static_cast<std::size_t>(joint) + 1]) {
            for (int parameter = 0; parameter < kLinkParameters; ++parameter) {
                columns.push_back((static_cast<int>(link) - 1) * kWidth + parameter);
            }
        }
        for (int parameter = kLinkParameters; parameter < kWidth; ++parameter) {
            columns.push_back(joint * kWidth + parameter);
        }
        found.emplace_back(columns, joint);
    }
    return found;
}

Fit fit_torques(const pinocchio::Model& model, const Measurements& measured) {
    const int width = model.nv * kWidth;
    const long samples = measured.position.cols();
    pinocchio::Data data(model);
    std::vector<JointTriangle> triangles = triangles_of(model);
    VectorXd position(model.nv), velocity(model.nv), acceleration(model.nv);
    for (long first = 0; first < samples; first += kPieceSamples) {
        const int length = static_cast<int>(std::min<long>(kPieceSamples, samples - first));
        for (int row = 0; row < length; ++row) {
            const long sample = first + row;
            position = measured.position.col(sample);
            velocity = measured.velocity.col(sample);
            acceleration = measured.acceleration.col(sample);
            const MatrixXd& regressor =
                pinocchio::computeJointTorqueRegressor(model, data, position, velocity, acceleration);
            for (int joint = 0; joint < model.nv; ++joint) {
                triangles[joint].put(row, regressor, velocity(joint), acceleration(joint),
                                     measured.torque(joint, sample));
            }
        }
        for (JointTriangle& triangle : triangles) triangle.reduce(length);
    }
    MatrixXd whole(0, width + 1);
    for (const JointTriangle& triangle : triangles) {
        const MatrixXd own = triangle.spread(width);
        const long before = whole.rows();
        whole.conservativeResize(before + own.rows(), Eigen::NoChange);
        whole.bottomRows(own.rows()) = own;
    }
    MatrixXd columns = whole.leftCols(width);
    // A column that is zero but for rounding errors must not be scaled up to one that counts.
    const double least = kDependent * columns.colwise().norm().maxCoeff();
    for (int column = 0; column < width; ++column) {
        const double norm = columns.col(column).norm();
        if (norm > least) {
            columns.col(column) /= norm;
        } else {
            columns.col(column).setZero();
        }
    }
    Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposed;
    decomposed.setThreshold(kDependent);
    decomposed.compute(columns);
    const VectorXd torque = whole.col(width);
    const VectorXd left = torque - columns * decomposed.solve(torque);
    return {decomposed.rank(), left.norm()};
}

double processor_time_s() {
    timespec now{};
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

// Largest resident memory; getrusage would count what the parent held when it started this program.
double peak_mb() {
    std::ifstream status("/proc/self/status");
    std::string line;
    while (std::getline(status, line)) {
        if (line.rfind("VmHWM:", 0) == 0) return std::stod(line.substr(6)) / 1024.0;
    }
    return std::nan("");
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 4) {
        std::fprintf(stderr, "usage: pinocchio_fit DATA.bin JOINTS.txt REPEATS\n");
        return 2;
    }
    try {
        const Measurements measured = read_measurements(argv[1]);
        const pinocchio::Model model = read_model(argv[2]);
        const int repeats = std::stoi(argv[3]);
        Fit fit{};
        std::string seconds;
        for (int repeat = 0; repeat < repeats; ++repeat) {
            const double began_s = processor_time_s();
            fit = fit_torques(model, measured);
            const double spent_s = processor_time_s() - began_s;
            char text[64];
            std::snprintf(text, sizeof(text), "%s{\"total\": %.6f}", repeat ? ", " : "", spent_s);
            seconds += text;
        }
        std::printf("{\"seconds\": [%s], \"base_parameters\": %ld, \"residual_norm_nm\": %.12g, \"peak_mb\": %.1f}\n",
                    seconds.c_str(), fit.base_parameters, fit.residual_norm,
                    peak_mb());
    } catch (const std::exception& error) {
        std::fprintf(stderr, "pinocchio_fit: %s\n", error.what());
        return 1;
    }
    return 0;
}
