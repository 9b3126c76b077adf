// One step of a session: where the tip is, what it feels.
//
//   c++ -std=c++17 -O2 -o session_step session_step.cpp
//   ./session_step 127.0.0.1 8000 turbinate 11.9 20 11
#include <chrono>
#include <cstdio>
#include <cstdlib>

#include "palpate_session.hpp"

int main(int argc, char** argv) {
    if (argc != 7) {
        std::fprintf(stderr, "usage: %s HOST PORT SCENE X Y Z\n", argv[0]);
        return 2;
    }
    try {
        palpate::Session session(argv[1], argv[2], argv[3]);
        const auto now = std::chrono::steady_clock::now().time_since_epoch();
        const palpate::Reply reply =
            session.step({std::atof(argv[4]), std::atof(argv[5]), std::atof(argv[6])},
                         std::chrono::duration<double>(now).count());
        std::printf("flags %u\n", reply.flags);
        std::printf("position %.17g %.17g %.17g\n", reply.position[0], reply.position[1],
                    reply.position[2]);
        std::printf("force %.17g %.17g %.17g\n", reply.force[0], reply.force[1], reply.force[2]);
        for (const auto& row : reply.tangent)
            std::printf("tangent %.17g %.17g %.17g\n", row[0], row[1], row[2]);
        std::printf("valid_radius %.9g\n", reply.valid_radius);
        std::printf("model %d\n", reply.model[0]);
        std::printf("steps %u\n", reply.steps);
        return 0;
    } catch (const palpate::Error& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
}
