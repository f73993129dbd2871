// The hand-written SIMD yardstick as a contestant: yardstick float32 4096 2
// Built against the folder that holds quad.cpp, which brings rollout<V>, al, nominal and Lanes.
#define main yardstick_main
#include "quad.cpp"
#undef main
#include <iostream>

template <class V> void compete(int vehicles, int threads) {
  using T = typename El<V>::T;
  constexpr int lanes = Lanes<V>::n;
  const int padded = (vehicles + lanes - 1) / lanes * lanes;
  const int steps = std::max(1000, std::min(200000, 16000000 / padded / 20 * 20));
  T *start = al<T>((size_t)NS * padded), *end = al<T>((size_t)NS * padded);
  T *coefficients = al<T>((size_t)NP * padded), nominal_values[NP];
  nominal(nominal_values);
  for (int j = 0; j < padded; j++) {
    for (int i = 0; i < NP; i++)
      coefficients[(size_t)i * padded + j] = nominal_values[i] * (T)(1 + 0.002 * ((j * 7 + i * 3) % 11 - 5) / 5.0);
    start[(size_t)QW * padded + j] = 1;
    start[(size_t)PZ * padded + j] = 1;
    for (int i = 0; i < 4; i++) start[(size_t)(O0 + i) * padded + j] = (T)793;
  }
  const int ticks = steps / 10;
  T *reference = al<T>((size_t)ticks * 11), *log = al<T>((size_t)ticks * 13 * padded);
  for (int k = 0; k < ticks; k++) {
    const double w = 1.2, a = w * k * 0.01;
    const double row[11] = {cos(a), sin(a), 1, -w * sin(a), w * cos(a), 0, -w * w * cos(a), -w * w * sin(a), 0, 1, 0};
    for (int i = 0; i < 11; i++) reference[(size_t)k * 11 + i] = (T)row[i];
  }
  auto run = [&] { rollout<V>(start, end, coefficients, padded, steps, reference, log, threads); };
  run();
  std::cout << "ready " << (double)vehicles * steps << " " << threads << " OpenMP threads, logging" << std::endl;
  for (std::string line; std::getline(std::cin, line);) {
    auto began = clk::now();
    run();
    std::cout << std::chrono::duration<double>(clk::now() - began).count() << std::endl;
  }
}

int main(int argc, char **argv) {
  if (argc != 4) return 2;
  const bool single = std::string(argv[1]) == "float32";
  const int vehicles = atoi(argv[2]), threads = atoi(argv[3]);
  if (vehicles == 1) single ? compete<float>(1, 1) : compete<double>(1, 1);
  else single ? compete<f16v>(vehicles, threads) : compete<d8v>(vehicles, threads);
}
