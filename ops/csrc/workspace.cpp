#include "workspace.h"

#include <cstdlib>
#include <mutex>
#include <new>

namespace gsparc {
namespace {

constexpr int kKept = 48;
constexpr int64_t kMostKept = int64_t(1) << 28, kLine = 64;  // bytes

struct Header {
    int64_t bytes;  // behind the header
};

std::mutex guard;
Header* kept[kKept];
int64_t kept_bytes = 0;

void* behind(Header* block) { return reinterpret_cast<char*>(block) + kLine; }
Header* header(void* memory) { return reinterpret_cast<Header*>(static_cast<char*>(memory) - kLine); }

}  // namespace

void* borrow(int64_t bytes) {
    {
        std::lock_guard<std::mutex> lock(guard);
        Header** best = nullptr;
        for (Header*& block : kept)
            if (block && block->bytes >= bytes && block->bytes <= 4 * bytes + 4096 && (!best || block->bytes < (*best)->bytes)) best = &block;
        if (best) {
            Header* block = *best;
            *best = nullptr, kept_bytes -= block->bytes;
            return behind(block);
        }
    }
    const int64_t whole = (bytes + bytes / 4 + 2 * kLine - 1) / kLine * kLine;  // room for a call a little larger
    Header* block = static_cast<Header*>(std::aligned_alloc(kLine, whole + kLine));
    if (!block) throw std::bad_alloc();
    block->bytes = whole;
    return behind(block);
}

void give_back(void* memory) {
    Header* block = header(memory);
    {
        std::lock_guard<std::mutex> lock(guard);
        if (kept_bytes + block->bytes <= kMostKept)
            for (Header*& place : kept)
                if (!place) {
                    place = block, kept_bytes += block->bytes;
                    return;
                }
    }
    std::free(block);
}

}  // namespace gsparc
