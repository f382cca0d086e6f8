// `driver FILE THREADS QUERIES`: queries of each thread that differ from those of one thread alone, and allocations
// meanwhile. `driver FILE...` with one number fewer loads each file and asks what is not refused.
#include <gsparc_field.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <atomic>
#include <cstdio>
#include <random>
#include <thread>
#include <vector>

static std::atomic<long> allocations{0};
static std::atomic<bool> counted{false};
#ifndef GSPARC_WATCHED
extern "C" void* __libc_malloc(size_t);
extern "C" void* malloc(size_t size) {
    if (counted) ++allocations;
    return __libc_malloc(size);
}
#endif

struct Asked {
    const gsparc_field* field;
    gsparc_facts facts = gsparc_about(field);
    void* scratch = aligned_alloc(64, (facts.scratch + 127) / 64 * 64);
    std::vector<float> values = std::vector<float>(facts.values + 2);
    explicit Asked(const gsparc_field* given) : field(given) {}
    ~Asked() { free(scratch); }
    int at(const float* place) {
        return gsparc_query(field, place, values.data(), &values[facts.values], &values[facts.values + 1], scratch);
    }
};

int main(int count, char** given) {
    char why[200];
    const bool many = count == 4 && atoi(given[2]) > 0;
    int refused = 0;
    for (int i = 1; !many && i < count; ++i) {
        gsparc_field* field = gsparc_load(given[i], why, sizeof why);
        refused += !field;
        if (!field) continue;
        alarm(10);  // a large answer may take long
        Asked one(field);
        for (float at : {0.5f, -40.0f, 2e7f, NAN}) {
            std::vector<float> place(one.facts.axes + 1, at);
            one.at(place.data());
        }
        gsparc_free(field);
    }
    if (!many) return printf("refused %d\n", refused), 0;
    gsparc_field* field = gsparc_load(given[1], why, sizeof why);
    if (!field) return puts(why), 1;
    Asked alone(field);
    constexpr int kPlaces = 256;
    std::mt19937 draw(0);
    std::uniform_real_distribution<float> within(0, 2);
    std::vector<float> places(kPlaces * alone.facts.axes);
    for (float& one : places) one = within(draw);
    std::vector<std::vector<float>> expected;
    for (int i = 0; i < kPlaces; ++i) alone.at(&places[i * alone.facts.axes]), expected.push_back(alone.values);
    const int threads = atoi(given[2]);
    const long each = atol(given[3]) / threads;
    std::atomic<int> ready{0}, done{0};
    std::atomic<bool> go{false}, end{false};
    std::atomic<long> wrong{0};
    std::vector<std::thread> team;
    for (int t = 0; t < threads; ++t)
        team.emplace_back([&, t] {
            Asked mine(field);
            for (++ready; !go;) std::this_thread::yield();
            for (long i = 0; i < each; ++i) {
                const int at = int((i * 17 + t * 31) % kPlaces);
                mine.at(&places[at * mine.facts.axes]);
                wrong += memcmp(mine.values.data(), expected[at].data(), mine.values.size() * sizeof(float)) != 0;
            }
            for (++done; !end;) std::this_thread::yield();
        });
    while (ready < threads) std::this_thread::yield();
    counted = true, go = true;
    while (done < threads) std::this_thread::yield();
    counted = false, end = true;
    for (auto& one : team) one.join();
    printf("queries %ld wrong %ld allocations %ld\n", each * threads, wrong.load(), allocations.load());
    gsparc_free(field);
}
