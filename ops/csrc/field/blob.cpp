#include "blob.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <new>

#include "gsparc_field.h"

namespace gsparc {

struct Section {
    char name[24];
    uint32_t type, unused;
    int64_t offset, count;
};

namespace {

struct Header {
    char magic[8];
    uint32_t version, checksum;  // CRC-32 of all that follows
    int64_t size, sections;
};
constexpr int64_t kLine = 64, kChecked = 16;  // bytes; where the checksum begins

uint32_t crc32(const unsigned char* bytes, int64_t size) {
    uint32_t table[256], crc = ~0u;
    for (uint32_t i = 0; i < 256; ++i) {
        uint32_t c = i;
        for (int bit = 0; bit < 8; ++bit) c = c >> 1 ^ (c & 1 ? 0xEDB88320u : 0);
        table[i] = c;
    }
    for (int64_t i = 0; i < size; ++i) crc = crc >> 8 ^ table[(crc ^ bytes[i]) & 255];
    return ~crc;
}

int64_t bytes_of(Type type) { return type == Type::kSingle || type == Type::kInt32 ? 4 : 8; }

}  // namespace

void refuse(const char* format, ...) {
    Refused found;
    va_list rest;
    va_start(rest, format);
    vsnprintf(found.why, sizeof found.why, format, rest);
    va_end(rest);
    throw found;
}

Blob::Blob(const void* bytes, int64_t size) {
    Header head;
    if (size < int64_t(sizeof head)) refuse("%lld bytes are too few for an exported field", (long long)size);
    memcpy(&head, bytes, sizeof head);
    if (memcmp(head.magic, "GSPARC\r\n", 8)) refuse("this is no exported field (or of another byte order)");
    if (head.version != GSPARC_FIELD_VERSION)
        refuse("version %u of exported fields; this library reads version %d: export again", head.version, GSPARC_FIELD_VERSION);
    if (head.size != size) refuse("%lld bytes, %lld were written: the file is cut off", (long long)size, (long long)head.size);
    if (crc32(static_cast<const unsigned char*>(bytes) + kChecked, size - kChecked) != head.checksum)
        refuse("the checksum is wrong: the file is damaged");
    if (head.sections < 1 || head.sections > (size - int64_t(sizeof head)) / int64_t(sizeof(Section))) refuse("a table beyond the file");
    const auto* table = reinterpret_cast<const char*>(bytes) + sizeof head;
    for (int64_t i = 0; i < head.sections; ++i) {
        Section one;
        memcpy(&one, table + i * sizeof one, sizeof one);
        const bool known = one.type <= uint32_t(Type::kInt64) && !one.name[sizeof one.name - 1];
        if (!known || one.offset < 0 || one.offset % kLine || one.count < 0 || one.offset > size ||
            one.count > (size - one.offset) / bytes_of(Type(one.type)))
            refuse("array %lld lies beyond the file", (long long)i);
    }
    data_ = static_cast<char*>(aligned_alloc(kLine, (size + kLine - 1) / kLine * kLine));
    if (!data_) throw std::bad_alloc();
    memcpy(data_, bytes, size);
    sections_ = reinterpret_cast<const Section*>(data_ + sizeof head), many_ = head.sections;
}

Blob::~Blob() { free(data_); }

int64_t Blob::count(const char* name) const {
    for (int64_t i = 0; i < many_; ++i)
        if (!strcmp(sections_[i].name, name)) return sections_[i].count;
    return 0;
}

const void* Blob::find(const char* name, Type type, int64_t count) const {
    for (int64_t i = 0; i < many_; ++i) {
        const Section& one = sections_[i];
        if (strcmp(one.name, name)) continue;
        if (one.type != uint32_t(type) || one.count != count)
            refuse("%s has %lld numbers, %lld are needed", name, (long long)one.count, (long long)count);
        return data_ + one.offset;
    }
    if (count) refuse("%s is missing", name);
    return nullptr;
}

Numbers::Numbers(const Blob& blob) {
    const int64_t count = blob.count("numbers");
    blob.read("numbers", at, count);
    end = at + count;
}

double Numbers::next() {
    if (at == end) refuse("numbers are missing");
    if (!isfinite(*at)) refuse("a number that is not finite");
    return *at++;
}

int Numbers::size(int64_t most) {
    const double found = next();
    if (!(found >= 0 && found <= double(most)) || found != floor(found)) refuse("%g is no size", found);
    return int(found);
}

}  // namespace gsparc
