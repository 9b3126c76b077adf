// A session of Palpate for C++17 on POSIX systems: one header, no dependencies.
//
// The structs below are the frames of version 2: little-endian, every member at a multiple of its
// size, so that a little-endian machine copies them as they are. Units: mm, mN, kPa, s. What the
// members mean is said in online/PROTOCOL.md and in the greeting that a session starts with.
#pragma once

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <cctype>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

namespace palpate {

constexpr std::uint16_t version = 2;

enum Output : std::uint16_t {
    coordinates = 1,
    displacement = 2,
    von_mises = 4,
    stress = 8,
    half = 16,
    parts = 32,
};

enum Flag : std::uint16_t {
    contact = 1,
    converged = 2,
    in_range = 4,
    clamped = 8,
    fallback = 16,
    stalled = 32,
    first = 64,
    too_deep = 128,
    beside = 256,
};

enum Reason : std::uint32_t {
    none = 0,
    no_equilibrium = 1,
    below_surface = 2,
};

struct Request {
    std::uint16_t version;
    std::uint16_t outputs;
    std::uint32_t seq;
    double client_time;
    double position[3];
};

struct Reply {
    std::uint16_t version;
    std::uint16_t flags;
    std::uint32_t seq;
    double client_time;
    double server_received;
    double server_sent;
    double position[3];
    double force[3];
    double tangent[3][3];
    double energy;
    float solve_time;
    float valid_radius;
    float contact_point[3];
    float normal[3];
    float depth;
    float penetration;
    float error_displacement;
    float error_von_mises;
    float error_force;
    float min_jacobian;
    float max_von_mises;
    float p99_von_mises;
    std::int32_t model[4];
    float weight[4];
    std::uint32_t superseded;
    std::uint32_t nodes;
    std::uint16_t iterations;
    std::uint16_t steps;
    std::uint16_t coordinates;
    std::uint16_t outputs;
    float depth_limit;
    std::uint32_t reason;
};

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "frames are little-endian");
static_assert(sizeof(Request) == 40 && offsetof(Request, position) == 16);
static_assert(sizeof(Reply) == 280 && offsetof(Reply, force) == 56);
static_assert(offsetof(Reply, tangent) == 80 && offsetof(Reply, solve_time) == 160);
static_assert(offsetof(Reply, model) == 224 && offsetof(Reply, reason) == 276);

// Thrown for whatever ends a session or refuses a frame; says why.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// A session over a plain socket. Not for several threads at once.
class Session {
public:
    Session(const std::string& host, const std::string& port, const std::string& scene) {
        connect_to(host, port);
        try {
            shake_hands(host + ":" + port, scene);
            greeting_ = as_text(receive_message());
        } catch (...) {
            ::close(socket_);
            throw;
        }
    }

    ~Session() {
        try {
            const std::uint8_t code[2] = {0x03, 0xe8};  // 1000, all is well
            send_message(close_message, code, sizeof code);
        } catch (const Error&) {
            // it has ended already
        }
        ::close(socket_);
    }

    Session(const Session&) = delete;
    Session& operator=(const Session&) = delete;

    // What the service said of the scene and of its frames, JSON.
    const std::string& greeting() const { return greeting_; }

    // Sends a position of the tip (mm) and waits for what it feels there.
    Reply step(const std::array<double, 3>& position, double client_time) {
        Request request{version, 0, ++seq_, client_time, {position[0], position[1], position[2]}};
        send_message(binary_message, &request, sizeof request);
        for (;;) {
            const Message message = receive_message();
            if (message.kind == text_message) throw Error(as_text(message));
            Reply reply;
            if (message.payload.size() < sizeof reply) throw Error("the reply is too short");
            std::memcpy(&reply, message.payload.data(), sizeof reply);
            if (reply.version != version) throw Error("the reply is of another version");
            if (reply.seq == seq_) return reply;
        }
    }

private:
    enum Kind : std::uint8_t {
        text_message = 1,
        binary_message = 2,
        close_message = 8,
        ping = 9,
        pong = 10,
    };

    struct Message {
        Kind kind;
        std::vector<std::uint8_t> payload;
    };

    void connect_to(const std::string& host, const std::string& port) {
        addrinfo hints{}, *found = nullptr;
        hints.ai_socktype = SOCK_STREAM;
        if (::getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0)
            throw Error("no such host: " + host);
        for (addrinfo* at = found; at != nullptr && socket_ < 0; at = at->ai_next) {
            socket_ = ::socket(at->ai_family, at->ai_socktype, at->ai_protocol);
            if (socket_ >= 0 && ::connect(socket_, at->ai_addr, at->ai_addrlen) != 0) {
                ::close(socket_);
                socket_ = -1;
            }
        }
        ::freeaddrinfo(found);
        if (socket_ < 0) throw Error("nobody answers at " + host + ":" + port);
        const int yes = 1;  // a frame is sent at once, not when more has gathered
        ::setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    }

    // RFC 6455, section 4.1. The key guards against caches, which have no part in this; so it may
    // be constant, and its echo goes unchecked.
    void shake_hands(const std::string& host, const std::string& scene) {
        const std::string request = "GET /scenes/" + scene + "/session HTTP/1.1\r\nHost: " + host +
                                    "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                                    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
                                    "Sec-WebSocket-Version: 13\r\n\r\n";
        send_all(request.data(), request.size());
        std::string head;
        while (head.size() < 4 || head.compare(head.size() - 4, 4, "\r\n\r\n") != 0) {
            char next;
            receive_all(&next, 1);
            head += next;
        }
        if (head.compare(0, 12, "HTTP/1.1 101") == 0) return;
        const std::string status = head.substr(0, head.find('\r'));
        for (char& c : head) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
        const std::size_t at = head.find("content-length: ");
        std::string why(at == std::string::npos ? 0 : std::stoul(head.substr(at + 16)), ' ');
        receive_all(&why[0], why.size());
        throw Error("the session was refused: " + status + ": " + why);
    }

    // Messages of at most 125 bytes; what a client sends is masked (section 5.3).
    void send_message(Kind kind, const void* payload, std::size_t size) {
        std::vector<std::uint8_t> frame(6 + size);
        frame[0] = 0x80 | kind;
        frame[1] = static_cast<std::uint8_t>(0x80 | size);
        const std::uint32_t mask = random_();
        std::memcpy(&frame[2], &mask, 4);
        const auto* from = static_cast<const std::uint8_t*>(payload);
        for (std::size_t i = 0; i < size; ++i) frame[6 + i] = from[i] ^ frame[2 + i % 4];
        send_all(frame.data(), frame.size());
    }

    // The next message for us; the service sends none in pieces.
    Message receive_message() {
        for (;;) {
            std::uint8_t head[2];
            receive_all(head, 2);
            std::uint64_t size = head[1] & 0x7f;
            if (size >= 126) {
                std::uint8_t extended[8];
                const std::size_t bytes = size == 126 ? 2 : 8;
                receive_all(extended, bytes);
                size = 0;
                for (std::size_t i = 0; i < bytes; ++i) size = size << 8 | extended[i];
            }
            Message message{static_cast<Kind>(head[0] & 0x0f), {}};
            message.payload.resize(size);
            receive_all(message.payload.data(), size);
            if (message.kind == ping) {
                send_message(pong, message.payload.data(), message.payload.size());
            } else if (message.kind == close_message) {
                const std::string why = as_text(message);
                throw Error("the session was closed: " + (why.size() > 2 ? why.substr(2) : why));
            } else if (message.kind == text_message || message.kind == binary_message) {
                return message;
            }
        }
    }

    static std::string as_text(const Message& message) {
        return {message.payload.begin(), message.payload.end()};
    }

    void send_all(const void* data, std::size_t size) {
        const char* at = static_cast<const char*>(data);
        while (size > 0) {
            const ssize_t sent = ::send(socket_, at, size, MSG_NOSIGNAL);
            if (sent <= 0) throw Error("the connection broke");
            at += sent;
            size -= static_cast<std::size_t>(sent);
        }
    }

    void receive_all(void* data, std::size_t size) {
        char* at = static_cast<char*>(data);
        while (size > 0) {
            const ssize_t got = ::recv(socket_, at, size, 0);
            if (got <= 0) throw Error("the connection broke");
            at += got;
            size -= static_cast<std::size_t>(got);
        }
    }

    int socket_ = -1;
    std::uint32_t seq_ = 0;
    std::string greeting_;
    std::mt19937 random_{std::random_device{}()};
};

}  // namespace palpate
